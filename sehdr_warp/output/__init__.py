"""Output of a trained scene: EXR, brackets, PLY, previews and reports; files appear whole or not at all.

An argument `run` is a RenderableScene: a Run, Splats from a file of Gaussians, or a MergedScene.
"""
