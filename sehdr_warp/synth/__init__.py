"""Photos of HDR truth, exposed as a camera would."""
