"""The responses with a formula, by name; needs nothing of torch."""

DESCRIPTIONS = {
    "camera": "a camera's own JPEG: Rec.709 with a roll-off into white",
    "srgb": "sRGB (IEC 61966-2-1): renders, and photos developed without a tone curve",
    "rec709": "Rec.709 video (ITU-R BT.709)",
    "gamma-2.2": "a power law; gamma-G with any G from 1 to 5",
    "linear": "values proportional to light",
    "hdr-nerf": "Reinhard's curve and gamma 2.2, of HDR-NeRF's sets; also reinhard-gamma",
    "filmic": "Hable's filmic curve (Uncharted 2), shown as sRGB",
    "gain-map": "sRGB, for light from gain maps, whose codes reach up to four stops above white",
    "aces": "Narkowicz's fit to the ACES display transform, shown as sRGB",
}
"""Response of each name; without aliases and without other exponents of `gamma-`."""
