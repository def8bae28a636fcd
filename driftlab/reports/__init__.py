"""What people look at: pages, figures, screens."""
