"""The plugins that come with driftlab; each registers itself through the entry points of the distribution."""
