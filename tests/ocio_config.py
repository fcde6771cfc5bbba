"""An OpenColorIO config with one view."""


def ocio_config(transform: str, search_path: str = ".") -> str:
    """Return the text of a config whose view V is a transform in OCIO's YAML."""
    return f"""ocio_profile_version: 2
search_path: {search_path}
strictparsing: true
roles: {{default: raw, scene_linear: raw, aces_interchange: raw, cie_xyz_d65_interchange: raw}}
file_rules:
  - !<Rule> {{name: Default, colorspace: default}}
displays:
  D:
    - !<View> {{name: V, colorspace: out}}
colorspaces:
  - !<ColorSpace>
    name: raw
  - !<ColorSpace>
    name: out
    from_scene_reference: {transform}
"""
