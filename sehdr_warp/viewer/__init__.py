"""A trained scene in a browser: float frames from here, exposure and all looks in the page."""
