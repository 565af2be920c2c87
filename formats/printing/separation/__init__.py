"""Removal of black ink from PDF documents."""
