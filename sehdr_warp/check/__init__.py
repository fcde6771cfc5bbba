"""`sehdr-warp check`: rendering of stiff and extreme scenes against float64 truth."""
