"""Localization of single photodiodes in a known scene."""
