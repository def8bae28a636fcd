"""Stimuli: how the input of a triad is known while its terms are fitted."""
