"""Colors that files state: primaries, transfer functions and ICC profiles, and their way to linear Rec.709."""
