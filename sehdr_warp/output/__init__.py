"""Output of a trained scene: EXR, brackets, PLY, previews and reports; files appear whole or not at all.

- render_views.py, view_images.py, brackets.py, film.py: rendered views. cameras/, world_transform.py: which views.
- images/, picture_header.py: their files (OpenEXR, PNG, JPEG, Ultra HDR), color spaces and tone maps.
- lighting/: environment maps and lights. export/: Gaussians and proxy meshes for other programs.
- report/, scene_page.py, notebook.py: pages, of html.py, light_pictures.py and page/.

An argument `run` is a RenderableScene: a Run, Splats from a file of Gaussians, or a MergedScene.
"""
