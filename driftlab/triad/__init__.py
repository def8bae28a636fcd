"""Scale factor and misalignment of a triad over temperature, from stimuli: turntable, placements, tumbles."""
