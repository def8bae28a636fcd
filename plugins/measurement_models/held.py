"""Placeholder while moving."""

from __future__ import annotations
