"""CUDA graphs: capture of launches, and renders that are replayed with their backward passes."""
