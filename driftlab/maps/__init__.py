"""Fitting thermal maps on recordings at rest."""
