"""A bias model and an effect for driftlab, as a third party would ship them."""
