"""The host side of training: compiled programs, the loop around them, and processes."""
