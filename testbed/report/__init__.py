"""Figures and pages that show a record."""
