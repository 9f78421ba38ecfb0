"""blender -b --factory-startup --python-exit-code 3 -P blender_import.py -- MODEL SCENE.xml OUTPUT [SAMPLES]

Imports a GLB or OBJ, prints what Blender made of it as a line of JSON behind `FOUND`, and renders it with the camera
and the environment map of an exported Mitsuba scene: OUTPUT_lit.exr with its light, OUTPUT_unlit.exr the bare base
colour. Needs Blender 3.4 or newer; runs in Blender's own Python.
"""

import json
import math
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import bpy
import numpy
from mathutils import Matrix, Vector

numpy.bool = bool  # Debian's Blender 3.4 still asks for this name, which its numpy has dropped

MODEL, SCENE, OUTPUT, *REST = sys.argv[sys.argv.index("--") + 1 :]
SAMPLES = int(REST[0]) if REST else 32


def from_y_up(text):
    x, y, z = (float(value) for value in text.split(","))
    return Vector((x, -z, y))


def imported():
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    if MODEL.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=MODEL)
    else:
        bpy.ops.wm.obj_import(filepath=MODEL)
    found = {}
    for thing in bpy.data.objects:
        entry = {"parent": thing.parent.name if thing.parent else None, "type": thing.type}
        if thing.type == "MESH":
            points = [thing.matrix_world @ vertex.co for vertex in thing.data.vertices]
            entry["vertices"] = len(points)
            entry["low"] = [min(point[axis] for point in points) for axis in range(3)]
            entry["high"] = [max(point[axis] for point in points) for axis in range(3)]
            entry["uv"] = [layer.name for layer in thing.data.uv_layers]
            entry["colours"] = [layer.name for layer in thing.data.color_attributes]
            entry["extras"] = {key: thing[key] for key in thing.keys() if isinstance(thing[key], (str, int, float))}
            entry["materials"] = {m.name: described(m) for m in thing.data.materials if m}
        found[thing.name] = entry
    return found


def described(material):
    images = {}
    for node in material.node_tree.nodes:
        if node.type == "TEX_IMAGE" and node.image:
            images[node.image.name] = [node.image.size[0], node.image.size[1], node.image.colorspace_settings.name]
    shader = shader_of(material)
    values = (
        {}
        if shader is None
        else {
            name: list(shader.inputs[name].default_value)[:3]
            if name == "Base Color"
            else shader.inputs[name].default_value
            for name in ("Base Color", "Roughness", "Metallic")
        }
    )
    linked = [] if shader is None else [s.name for s in shader.inputs if s.is_linked]
    return {"images": images, "values": values, "linked": linked}


def shader_of(material):
    return next((node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"), None)


def set_camera(sensor):
    look = sensor.find("transform/lookat")
    origin, target, up = (from_y_up(look.get(key)) for key in ("origin", "target", "up"))
    back = (origin - target).normalized()
    right = up.cross(back).normalized()
    camera = bpy.data.cameras.new("camera")
    camera.sensor_fit = "HORIZONTAL"
    camera.angle = math.radians(float(sensor.find("float[@name='fov']").get("value")))
    camera.clip_end = 1e5
    thing = bpy.data.objects.new("camera", camera)
    rotation = Matrix((right, back.cross(right), back)).transposed().to_4x4()
    thing.matrix_world = Matrix.Translation(origin) @ rotation
    bpy.context.scene.collection.objects.link(thing)
    bpy.context.scene.camera = thing


def set_light(emitter):
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(
        str(Path(SCENE).parent / emitter.find("string[@name='filename']").get("value"))
    )
    place, mapping = nodes.new("ShaderNodeTexCoord"), nodes.new("ShaderNodeMapping")
    # Mitsuba's +y-up latitude-longitude picture begins a quarter turn from Blender's.
    mapping.inputs["Rotation"].default_value[2] = math.radians(90)
    links.new(place.outputs["Generated"], mapping.inputs["Vector"])
    links.new(mapping.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], nodes["Background"].inputs["Color"])
    scale = emitter.find("float[@name='scale']")
    nodes["Background"].inputs["Strength"].default_value = 1.0 if scale is None else float(scale.get("value"))


def make_unlit():
    bpy.context.scene.world = None
    for material in bpy.data.materials:
        shader = shader_of(material) if material.use_nodes else None
        if shader is None:
            continue
        nodes, links = material.node_tree.nodes, material.node_tree.links
        glow = nodes.new("ShaderNodeEmission")
        colour = shader.inputs["Base Color"]
        glow.inputs["Color"].default_value = colour.default_value
        if colour.is_linked:
            links.new(colour.links[0].from_socket, glow.inputs["Color"])
        output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
        links.new(glow.outputs["Emission"], output.inputs["Surface"])


def render(path, samples):
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", samples, False
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = 256
    scene.render.film_transparent = True
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.image_settings.color_mode = "RGBA"
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


root = ET.parse(SCENE).getroot()
print("FOUND " + json.dumps(imported()), flush=True)
set_camera(root.find("sensor"))
emitter = root.find("emitter[@type='envmap']")
if emitter is not None:
    set_light(emitter)
render(OUTPUT + "_lit.exr", SAMPLES)
make_unlit()
render(OUTPUT + "_unlit.exr", 16)
