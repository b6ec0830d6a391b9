"""Many builds with one command, in processes of their own."""
