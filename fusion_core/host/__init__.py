"""The host of plugins: reading configurations, the registry, and the guard about each plugin."""
