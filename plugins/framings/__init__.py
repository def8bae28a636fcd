"""Framings: the bytes of a sample as devices send them, one file each."""
