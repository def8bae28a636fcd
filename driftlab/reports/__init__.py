"""Reports: pages, figures and tables of results."""
