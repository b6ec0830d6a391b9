"""The pyramid filter: kernel design, its compiled loops, edges, and the cascade of levels."""
