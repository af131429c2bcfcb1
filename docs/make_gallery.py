"""Makes the pictures of docs/gallery.md: `JAXPRT_DATA=FOLDER python docs/make_gallery.py [SHEET ...]`.

Sheets are lead, systems, scenes and lights, one file each in docs/pictures. Pictures are at pixels, with four samples
each. All take some fifteen minutes on two cores.
"""

import os
import pathlib
import sys
from collections.abc import Callable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import jaxprt as prt
from jaxprt.relit import Clusters, Harmonics, Lobes
from jaxprt.relit.exact import exact_picture
from jaxprt.scene import TexturedMaterial, builtin
from jaxprt.scene.environment import rotate
from jaxprt.scene.mesh import ground_plane
from jaxprt.view.stages import about

FOLDER = pathlib.Path(__file__).parent / "pictures"
KEPT = pathlib.Path(__file__).parents[1] / "output" / "gallery"  # what was precomputed, for later runs
DATA = pathlib.Path(os.environ.get("JAXPRT_DATA", ""))
EDGE = 384
LARGE = 1024  # pixels along an edge of the first picture
HALF = np.diag([-1.0, 1.0, -1.0])  # half a turn, which puts a light's bright side before the objects
LIGHTS = {
    "Grace Cathedral": "grace_cross.hdr",
    "Eucalyptus Grove": "eucalyptus_rnl_cross.hdr",
    "St. Peter's": "stpeters_cross.hdr",
    "Uffizi": "uffizi_latlong_256x128.hdr",
    "Ennis House": "ennis_latlong_256x128.hdr",
    "courtyard": "polyhaven_courtyard_1k.exr",
    "city": "polyhaven_city_1k.exr",
    "studio": "polyhaven_studio_1k.exr",
    "sunrise": "polyhaven_sunrise_1k.exr",
    "KernerEnv": "KernerEnvLatLong.exr",
    "daylight (embedded)": "",
    "studio (embedded)": "",
}


def light(name: str) -> prt.Environment:
    """One of `LIGHTS`."""
    if name.endswith("(embedded)"):
        return builtin.daylight() if name.startswith("daylight") else builtin.studio()
    return prt.load_environment(DATA / "env" / LIGHTS[name])


def matte(color: float | tuple[float, ...]) -> TexturedMaterial:
    """A ground."""
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0)


def standing(mesh: prt.scene.Mesh, material: TexturedMaterial, *, vertices: int = 6000) -> prt.Scene:
    """A mesh on a matte ground."""
    ground = ground_plane(mesh, vertices=vertices)
    return prt.Scene([prt.Part("object", mesh, material), prt.Part("ground", ground, matte(0.5))])


def camera(mesh: prt.scene.Mesh, *, azimuth: float = 0.6, elevation: float = 0.35) -> prt.Camera:
    """A view of a mesh, without its ground."""
    return prt.scene.camera.orbit(mesh, azimuth=azimuth, elevation=elevation, width=EDGE, height=EDGE)


def exposed(image, like=None) -> np.ndarray:
    """For the screen, as bright as the middle of the picture, or of another one, asks for."""
    middle = slice(EDGE // 4, 3 * EDGE // 4)
    stops = prt.image.automatic_exposure((image if like is None else like)[middle, middle])
    return np.round(255 * np.asarray(prt.image.display(prt.image.expose(image, stops=stops)))).astype(np.uint8)


def sheet(name: str, pictures: dict[str, np.ndarray], *, columns: int) -> None:
    """Writes pictures with their names below, in rows."""
    rows, line = -(-len(pictures) // columns), 24
    whole = Image.new("RGB", (columns * EDGE, rows * (EDGE + line)), "white")
    font = ImageFont.load_default(size=16)
    for number, (text, picture) in enumerate(pictures.items()):
        x, y = (number % columns) * EDGE, (number // columns) * (EDGE + line)
        whole.paste(Image.fromarray(picture), (x, y))
        ImageDraw.Draw(whole).text((x + EDGE // 2, y + EDGE + line // 2), text, "black", font, "mm")
    FOLDER.mkdir(exist_ok=True)
    whole.save(FOLDER / f"gallery_{name}.jpg", quality=85)
    print(FOLDER / f"gallery_{name}.jpg", flush=True)


def systems() -> None:
    """One scene by each system, and exactly, in one light."""
    mesh = prt.load_mesh(DATA / "meshes" / "spot.obj")
    scene = standing(mesh, TexturedMaterial(base_color=(0.6, 0.25, 0.1), metallic=0.0, roughness=0.35))
    environment, eye, pictures = rotate(light("Grace Cathedral"), HALF), camera(mesh, azimuth=2.6), {}
    made: dict[str, tuple[prt.relit.recipes.Recipe, int]] = {
        "harmonic, degree 4": (Harmonics(4), 0),
        "separable, 16 terms": (Clusters(16), 0),
        "lobe, 8 lobes": (Lobes(8), 0),
        "lobe, and a bounce": (Lobes(8), 1),
    }
    for name, (recipe, bounces) in made.items():
        relit = prt.precompute(scene, system=recipe, bounces=bounces, progress=False)
        pictures[name] = relit.picture(environment, eye)
        if bounces == 0 and name.startswith("lobe"):
            exact = exact_picture(relit.scene, relit.shading, [environment], eye, most=2 * EDGE**2)
            pictures["exact (reference)"] = exact.color[0]
    shown = {name: exposed(each, pictures["exact (reference)"]) for name, each in pictures.items()}
    sheet("systems", shown, columns=3)


def scenes() -> None:
    """Scenes with their materials, and meshes with one each, by lobes."""
    pictures, courtyard = {}, rotate(light("courtyard"), HALF)
    for name in ("Duck", "CesiumMilkTruck", "BoxTextured"):
        scene = prt.load_scene(DATA / "scenes" / f"{name}.glb")
        ground = prt.Part("ground", ground_plane(scene.mesh, vertices=6000), matte(0.5))
        whole = prt.Scene([*scene.parts, ground])
        relit = prt.precompute(whole, system=Lobes(6), path=KEPT / f"{name} on a ground", progress=False)
        pictures[name] = exposed(relit.picture(courtyard, camera(scene.mesh)))
    for name, file, color, metallic, roughness, azimuth in (
        ("Stanford bunny, gold", "stanford_bunny.ply", (1.0, 0.71, 0.29), 1.0, 0.4, 0.0),
        ("Nefertiti, plaster", "nefertiti.ply", (0.8, 0.76, 0.7), 0.0, 0.8, 0.3),
        ("Suzanne, plastic", "suzanne.obj", (0.1, 0.3, 0.6), 0.0, 0.3, 0.4),
    ):
        mesh = prt.load_mesh(DATA / "meshes" / file)
        if file == "nefertiti.ply":  # whose third axis points up
            mesh = prt.scene.mesh.rotate(mesh, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
        material = TexturedMaterial(base_color=color, metallic=metallic, roughness=roughness)
        relit = prt.precompute(standing(mesh, material), system=Lobes(6), path=KEPT / name, progress=False)
        pictures[name] = exposed(relit.picture(courtyard, camera(mesh, azimuth=azimuth)))
    sheet("scenes", pictures, columns=3)


def lights() -> None:
    """The duck in each light, by lobes."""
    scene = prt.load_scene(DATA / "scenes" / "Duck.glb")
    relit = prt.precompute(scene, system="lobe", path=KEPT / "Duck", progress=False)
    view = relit.picture_view(camera(scene.mesh))
    sheet("lights", {name: exposed(view.picture(light(name))) for name in LIGHTS}, columns=4)


def lead() -> None:
    """A cake that stands on the ground under a sun, by the defaults with one bounce."""
    cake = prt.load_scene(DATA / "foreign" / "cakeBirthday.glb")
    scene = prt.Scene([*cake.parts, prt.Part("ground", ground_plane(cake.mesh), matte(0.5))])
    beach = prt.load_environment(DATA / "env" / "polyhaven_spiaggia_di_mondello_1k.hdr")
    relit = prt.precompute(scene, system="lobe", bounces=1, path=KEPT / "cake", progress=False)
    eye = prt.scene.camera.orbit(cake.mesh, azimuth=0.5, elevation=0.3, width=LARGE, height=LARGE)
    picture = relit.picture(rotate(beach, about(2.2)), eye)
    shown = prt.image.display(picture, tone="neutral", stops=relit.exposure(picture, eye))
    path = FOLDER / "gallery_cake.jpg"
    Image.fromarray(np.round(255 * np.asarray(shown)).astype(np.uint8)).save(path, quality=88)
    print(path, flush=True)


SHEETS: dict[str, Callable[[], None]] = {"lead": lead, "systems": systems, "scenes": scenes, "lights": lights}

if __name__ == "__main__":
    for each in sys.argv[1:] or SHEETS:
        SHEETS[each]()
