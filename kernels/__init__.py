"""Every Warp kernel. Imports warp only; torch and the rest of the package are unknown here."""
