"""Other rasterizers' functions, made of ours."""
