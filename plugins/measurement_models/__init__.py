"""What the filter knows of the sensors: the states that they share, and what is measured at each epoch."""
