"""`sehdr-warp check`: numerical stability on stiff and extreme cases, against float64 truth."""
