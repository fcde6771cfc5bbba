"""Decoders of image files (PNG, JPEG, TIFF, HEIF, OpenEXR, Radiance), their metadata (EXIF, XMP) and gain maps."""
