"""Presets as TOML files, installed with the package."""
