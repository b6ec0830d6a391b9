"""Whether datasets hold what they claim, how they differ, and making damage good."""
