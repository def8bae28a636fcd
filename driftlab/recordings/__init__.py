"""Recordings on their way from a source to filter updates: screened samples, integrated over epochs."""
