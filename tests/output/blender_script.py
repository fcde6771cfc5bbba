"""Read our files with Blender; run by Python with bpy: blender_script.py FOLDER, prints JSON."""

import json
import math
import sys
from pathlib import Path

import bpy

folder = Path(sys.argv[1])
facts = json.loads((folder / "facts.json").read_text())
report = {"version": bpy.app.version_string}


def reset():
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 64
    scene.cycles.use_denoising = False
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1
    return scene


def render(scene, name, size):
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *size, 100
    scene.render.filepath = str(folder / name)
    bpy.ops.render.render(write_still=True)


def emitter(place, radius):
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, location=place)
    material = bpy.data.materials.new("light")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    emission, output = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    material.node_tree.links.new(emission.outputs[0], output.inputs[0])
    bpy.context.object.data.materials.append(material)


# Our axes have +Y up, Blender's +Z.
turned = lambda p: (p[0], -p[2], p[1])  # noqa: E731

scene = reset()
bpy.ops.wm.usd_import(filepath=str(folder / "cameras.usda"))
cameras = [each for each in bpy.data.objects if each.type == "CAMERA"]
report["cameras"] = sorted(each.name for each in cameras)
for point in facts["points"]:
    emitter(turned(point), facts["radius"])
[scene.camera] = cameras[:1]
for frame in facts["frames"]:
    scene.frame_set(frame)
    render(scene, f"match_{frame}.exr", facts["size"])

scene = reset()
world = scene.world or bpy.data.worlds.new("world")
scene.world = world
world.use_nodes = True
nodes, links = world.node_tree.nodes, world.node_tree.links
texture, mapping = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
coordinates = nodes.new("ShaderNodeTexCoord")
texture.image = bpy.data.images.load(str(folder / "env.exr"))
report["map"] = {"size": list(texture.image.size), "space": texture.image.colorspace_settings.name}
mapping.inputs["Rotation"].default_value = (0, 0, math.pi / 2)
links.new(coordinates.outputs["Generated"], mapping.inputs["Vector"])
links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
background = next(node for node in nodes if node.type == "BACKGROUND")
links.new(texture.outputs["Color"], background.inputs["Color"])
material = bpy.data.materials.new("grey")
material.use_nodes = True
material.node_tree.nodes.clear()
diffuse = material.node_tree.nodes.new("ShaderNodeBsdfDiffuse")
diffuse.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
output = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
material.node_tree.links.new(diffuse.outputs[0], output.inputs[0])
camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
camera.data.type, camera.data.ortho_scale = "ORTHO", 0.2
scene.collection.objects.link(camera)
scene.camera = camera
scene.cycles.max_bounces = 0
scene.cycles.samples = 1024
bpy.ops.mesh.primitive_plane_add(size=1)
plane = bpy.context.object
plane.data.materials.append(material)
from mathutils import Vector  # noqa: E402

for index, normal in enumerate(facts["normals"]):
    direction = Vector(turned(normal))
    turn = direction.to_track_quat("Z", "Y")
    plane.rotation_mode = camera.rotation_mode = "QUATERNION"
    plane.rotation_quaternion, camera.rotation_quaternion = turn, turn
    camera.location = direction * 0.5
    render(scene, f"lit_{index}.exr", (8, 8))

scene = reset()
for name in ("splats.glb", "splats.usdc", "proxy.usdc"):
    if (folder / name).exists():
        load = bpy.ops.import_scene.gltf if name.endswith("glb") else bpy.ops.wm.usd_import
        report[name] = sorted(load(filepath=str(folder / name)))
picture = bpy.data.images.load(str(folder / "picture.exr"))
report["picture"] = {"size": list(picture.size), "space": picture.colorspace_settings.name}
print("RESULT " + json.dumps(report))
