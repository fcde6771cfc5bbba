"""Launch Warp kernels on torch tensors: the one place that relies on internals of Warp."""
