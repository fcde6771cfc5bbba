"""gsplat's functions and strategies."""
