"""Where plugins and configurations meet: reading, the registry, and checks of what plugins answer."""
