"""RAW files of cameras: LibRaw's photos, and DNG developed by what the file states."""
