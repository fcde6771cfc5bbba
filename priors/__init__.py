"""Training of the prior for clipped light; not part of the installed package."""
