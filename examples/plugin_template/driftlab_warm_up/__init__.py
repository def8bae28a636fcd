"""A bias model for driftlab, as a third party would ship it."""
