"""Video clips as photos: decoding, the color that a clip states, and the choice of frames."""
