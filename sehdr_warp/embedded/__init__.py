"""The rendered HDR scene that ships with the package, as data files."""
