"""Output of a trained scene: EXR, brackets, PLY, previews and reports; files appear whole or not at all."""
