"""Descriptions of recordings and artifacts as plain values, for JSON and for reports."""
