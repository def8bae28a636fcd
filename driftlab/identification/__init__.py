"""Identification of the effects that a declared model lacks, from measured recordings."""
