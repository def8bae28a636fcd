"""A soak at rest: its rest, its means over blocks, its placements and its temperature."""
