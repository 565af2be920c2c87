"""Sheets as PDF at true size."""
