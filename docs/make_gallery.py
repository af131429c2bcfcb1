"""Makes the pictures and the two pages of docs/gallery.md: `JAXPRT_DATA=FOLDER python -m docs.make_gallery [NAME ...]`.

Names are bust, watch, leather, room and cake (one large picture each), lights and systems (sheets), and live and beside
(pages of HTML). Pictures are at pixels. What is precomputed is kept in output/gallery. All take about an hour on two
cores. The page beside Mitsuba needs the extra `bench`.
"""

import base64
import io
import os
import pathlib
import re
import subprocess
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial import cKDTree

import jaxprt as prt
from benchmarks import denoised
from benchmarks.published import interiors
from jaxprt.brdf import MetallicRoughness
from jaxprt.relit import Clusters, Harmonics, Lobes
from jaxprt.relit.exact import exact_picture
from jaxprt.scene import TexturedMaterial
from jaxprt.scene.environment import finer, resized, rotate
from jaxprt.scene.material import Texture
from jaxprt.scene.mesh import bounds, ground_plane, join, make_mesh, split
from jaxprt.scene.occluder import simplify
from jaxprt.view.stages import about

DOCS = pathlib.Path(__file__).parent
FOLDER = DOCS / "pictures"
KEPT = DOCS.parent / "output" / "gallery"  # what was precomputed, for later runs
DATA = pathlib.Path(os.environ.get("JAXPRT_DATA", ""))
EDGE = 384
LARGE = 1024  # pixels along an edge of a large picture
UPRIGHT = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # of a mesh whose third axis points up
MOST_BYTES = 2_000_000  # of the live page


class Shot(NamedTuple):
    """A picture to make.

    Attributes:
        scene: What is seen.
        camera: From where.
        light: The light, turned.
        bounces: How often light is reflected between surfaces.
        tone: Tone curve.
        stops: Stops that are added to the automatic exposure.
    """

    scene: prt.Scene
    camera: prt.Camera
    light: prt.Environment
    bounces: int = 0
    tone: str = "agx"
    stops: float = 0.0

    def relit(self, name: str) -> prt.RelitScene:
        """The scene by the default system, kept under a name."""
        return prt.precompute(self.scene, system="lobe", bounces=self.bounces, path=KEPT / name, progress=False)

    def shown(self, picture, stops: float) -> Image.Image:
        """A picture for the screen."""
        return as_image(prt.image.display(picture, tone=self.tone, stops=stops + self.stops))


def as_image(shown) -> Image.Image:
    """An image of eight bits."""
    return Image.fromarray(np.round(255 * np.asarray(shown)).astype(np.uint8))


def light(file: str, *, turn: float = 0.0) -> prt.Environment:
    """A light of the data folder, turned about the vertical axis by an angle in radians."""
    return rotate(prt.load_environment(DATA / "env" / file), about(turn))


def matte(color: float | tuple[float, ...], texture: Texture | None = None) -> TexturedMaterial:
    """A material without highlights."""
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0, base_color_texture=texture)


def plastic(color: float | tuple[float, ...], roughness: float, **more) -> TexturedMaterial:
    """A material with highlights of the light's color."""
    return TexturedMaterial(base_color=color, metallic=0.0, roughness=roughness, **more)


def metal(color: tuple[float, ...], roughness: float, **more) -> TexturedMaterial:
    """A metal."""
    return TexturedMaterial(base_color=color, metallic=1.0, roughness=roughness, **more)


def backdrop(mesh: prt.scene.Mesh, *, edge: int = 121) -> prt.scene.Mesh:
    """A photographer's paper: a floor below a mesh that bends up into a wall behind it, finest below the mesh."""
    low, high = bounds(mesh)
    unit, middle = float(np.linalg.norm(high - low)) / 2, (low + high) / 2
    place = np.linspace(-1, 1, edge)
    place = 0.35 * place + 0.65 * place**3
    front, back, radius, wall = 5.0, 2.5, 1.6, 5.0
    arc = np.pi / 2 * radius
    along = np.where(place < 0, place * front, place * (back + arc + wall))
    bends, rises = along > back, along > back + arc
    turn = (along - back) / radius
    z = np.select([rises, bends], [-(back + radius), -(back + radius * np.sin(turn))], -along)
    y = np.select([rises, bends], [radius + along - back - arc, radius * (1 - np.cos(turn))], 0.0)
    across, row = np.meshgrid(5 * place, np.arange(edge))
    position = np.stack([across, y[row], z[row]], -1).reshape(-1, 3) * unit
    floor = [middle[0], low[1] - 1e-3 * unit, middle[2]]
    face = prt.scene.mesh.grid_face(rows=edge, columns=edge)
    return make_mesh(position + floor, face[:, ::-1], name="backdrop")


def nefertiti(*, faces: int | None = None) -> prt.scene.Mesh:
    """The bust of Nefertiti, simplified to so many faces."""
    mesh = prt.load_mesh(DATA / "meshes" / "nefertiti.ply")
    return prt.scene.mesh.rotate(simplify(mesh, faces=faces) if faces else mesh, UPRIGHT)


def bust(*, faces: int | None = None, edge: int = 121) -> Shot:
    """A bust of bronze before dark paper, between the soft boxes of a studio."""
    mesh = nefertiti(faces=faces)
    bronze = metal((0.72, 0.43, 0.2), 0.32)
    parts = [
        prt.Part("bust", mesh, bronze),
        prt.Part("backdrop", backdrop(mesh, edge=edge), plastic((0.1, 0.085, 0.075), 0.5)),
    ]
    camera = prt.scene.camera.orbit(mesh, azimuth=0.35, elevation=0.08, width=LARGE, height=LARGE)
    return Shot(prt.Scene(parts, [camera]), camera, light("polyhaven_studio_1k.exr", turn=1.75 * np.pi), stops=0.3)


def watch() -> Shot:
    """A watch with a case of gold and a bracelet of steel."""
    case, bracelet, dial, _ = split(interiors.watch(step=0.05))
    whole = join([case, bracelet, dial])
    parts = [
        prt.Part("case", case, metal((0.95, 0.68, 0.36), 0.24)),
        prt.Part("bracelet", bracelet, metal((0.8, 0.79, 0.77), 0.28)),
        prt.Part("dial", dial, plastic((0.01, 0.025, 0.09), 0.3)),
        prt.Part("backdrop", backdrop(whole, edge=100), plastic((0.22, 0.21, 0.2), 0.5)),
    ]
    camera = prt.scene.camera.orbit(whole, azimuth=-0.45, elevation=0.32, width=LARGE, height=LARGE)
    return Shot(
        prt.Scene(parts), camera, light("polyhaven_studio_1k.exr", turn=1.75 * np.pi), tone="neutral", stops=1.1
    )


def grain(texels: int = 512, cells: int = 420) -> Texture:
    """A normal map of leather: cushions around random points, with grooves between them."""
    random = np.random.default_rng(0)
    point = random.random((cells, 2))
    point = np.concatenate([point + [right, up] for right in (-1, 0, 1) for up in (-1, 0, 1)])
    y, x = np.mgrid[:texels, :texels] / texels
    distance, _ = cKDTree(point).query(np.stack([x, y], -1), k=2)
    height = np.sqrt(np.minimum((distance[..., 1] - distance[..., 0]) * cells**0.5, 0.5))
    for _ in range(3):
        height = (height + sum(np.roll(height, step, axis) for step in (-1, 1) for axis in (0, 1))) / 5
    slope = [2.5 * (np.roll(height, -1, axis) - np.roll(height, 1, axis)) for axis in (1, 0)]
    normal = np.stack([-slope[0], slope[1], np.ones_like(height)], -1)
    return Texture((normal / np.linalg.norm(normal, axis=-1, keepdims=True) + 1) / 2, transform=3 * np.eye(2, 3))


def planks(texels: int = 512) -> Texture:
    """A floor of boards."""
    random = np.random.default_rng(3)
    y, x = np.mgrid[:texels, :texels] / texels
    board, row = 8 * x, (8 * x).astype(int)
    along = 2 * ((y + random.random(8)[row]) % 1)
    tone = random.uniform(0.75, 1.1, (8, 2))[row, along.astype(int)]
    fiber = np.repeat(random.standard_normal((texels // 32, texels)), 32, 0)
    for _ in range(24):
        fiber = (fiber + np.roll(fiber, 1, 0) + np.roll(fiber, -1, 0)) / 3
    joint = (np.abs(board % 1 - 0.5) > 0.485) | (np.abs(along % 1 - 0.5) > 0.496)
    value = np.where(joint, 0.35, 1) * np.clip(tone * (1 + 0.07 * fiber / fiber.std()), 0.2, 1.25)
    return Texture(np.clip(value[..., None] / 1.25 * [1.0, 0.92, 0.82], 0, 1))


def leather() -> Shot:
    """A machine part of steel on a pad of leather."""
    arm = prt.load_mesh(DATA / "meshes" / "rocker_arm.ply")
    low, high = bounds(arm)
    size, middle, extent = float(max(high - low)), (low + high) / 2, high - low
    thickness, half = 0.16 * size, (1.05 * extent[0] / 2 + 0.12 * size, extent[2] / 2 + 0.2 * size)
    bottom = (middle[0] - half[0], low[1] - thickness, middle[2] - half[1])
    top = (middle[0] + half[0], low[1] - 2e-3 * size, middle[2] + half[1])
    position, face, normal = interiors._block(bottom, top, 0.45 * thickness, step=0.03 * size)
    x, y, z = position.T
    place = np.stack([x + 0.7 * y, z + 0.7 * y], -1) / (0.9 * size)
    along = np.tile([1.0, 0, 0], (len(position), 1))
    pad = make_mesh(position, face, normal=normal, texture=place, tangent=along)
    parts = [
        prt.Part("arm", arm, metal((0.86, 0.84, 0.81), 0.34)),
        prt.Part("leather", pad, plastic((0.055, 0.022, 0.012), 0.4, normal_texture=grain())),
        prt.Part("backdrop", backdrop(pad, edge=90), matte((0.3, 0.28, 0.26))),
    ]
    camera = prt.scene.camera.orbit(arm, azimuth=0.42, elevation=0.4, width=LARGE, height=LARGE)
    return Shot(prt.Scene(parts), camera, light("polyhaven_studio_1k.exr", turn=0.4), stops=-0.9)


def room() -> Shot:
    """A room in the sun that shines through its window, with two bounces."""
    names = ("floor", "sofa", "window wall", "back wall", "right wall", "ceiling")
    names += ("rug", "table", "lamp", "vase", "picture", "cushions")
    wall, wood = matte((0.8, 0.77, 0.71)), plastic((0.62, 0.4, 0.23), 0.42, base_color_texture=planks())
    materials = [
        wood,
        plastic((0.035, 0.12, 0.12), 0.6),
        wall,
        wall,
        wall,
        matte((0.85, 0.85, 0.83)),
        matte((0.62, 0.55, 0.45)),
    ]
    materials += [plastic((0.3, 0.16, 0.08), 0.35), matte((0.85, 0.8, 0.65)), plastic((0.75, 0.3, 0.12), 0.3)]
    materials += [matte((0.2, 0.28, 0.33)), matte((0.8, 0.5, 0.1))]
    floor, *others = split(interiors.room())
    position = np.asarray(floor.position)
    boards = make_mesh(position, floor.face, normal=floor.normal, texture=position[:, [0, 2]] / 1.2)
    meshes = [boards, *others]
    parts = [prt.Part(*part) for part in zip(names, meshes, materials, strict=True)]
    camera = prt.Camera([1.15, 1.25, 2.9], [-0.25, 0.75, -1.0], [0, 1, 0], 0.95, LARGE, LARGE)
    return Shot(
        prt.Scene(parts),
        camera,
        rotate(prt.scene.builtin.daylight(), about(1.75 * np.pi)),
        bounces=2,
        tone="neutral",
        stops=0.4,
    )


def cake() -> Shot:
    """A cake that stands on the ground of a beach, whose sun is in one texel of the light."""
    file = prt.load_scene(DATA / "foreign" / "cakeBirthday.glb")
    ground = prt.Part("ground", ground_plane(file.mesh), matte(0.5))
    camera = prt.scene.camera.orbit(file.mesh, azimuth=0.5, elevation=0.3, width=LARGE, height=LARGE)
    beach = light("polyhaven_spiaggia_di_mondello_1k.hdr", turn=2.2)
    return Shot(prt.Scene([*file.parts, ground]), camera, beach, bounces=1, tone="neutral")


SHOTS: dict[str, Callable[[], Shot]] = {"bust": bust, "watch": watch, "leather": leather, "room": room, "cake": cake}


def lead(name: str) -> None:
    """Writes one large picture."""
    shot = SHOTS[name]()
    relit = shot.relit(name)
    picture = relit.picture(shot.light, shot.camera)
    write(name, shot.shown(picture, float(relit.exposure(picture, shot.camera))))


def write(name: str, image: Image.Image) -> None:
    """Writes a picture of the gallery."""
    path = FOLDER / f"gallery_{name}.jpg"
    image.save(path, quality=88)
    print(path, f"{path.stat().st_size:,} bytes", flush=True)


def systems() -> None:
    """One scene by each system, and exactly, in one light."""
    mesh = prt.load_mesh(DATA / "meshes" / "spot.obj")
    ground = prt.Part("ground", ground_plane(mesh, vertices=6000), matte(0.5))
    scene = prt.Scene([prt.Part("object", mesh, plastic((0.6, 0.25, 0.1), 0.35)), ground])
    environment, pictures = light("grace_cross.hdr", turn=np.pi), {}
    eye = prt.scene.camera.orbit(mesh, azimuth=2.6, elevation=0.35, width=EDGE, height=EDGE)
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
    middle = slice(EDGE // 4, 3 * EDGE // 4)
    stops = prt.image.automatic_exposure(pictures["exact (reference)"][middle, middle])
    write("systems", sheet({name: prt.image.display(picture, stops=stops) for name, picture in pictures.items()}))


def sheet(pictures: dict[str, Float[np.ndarray, "h w 3"]], *, columns: int = 3) -> Image.Image:
    """Pictures with their names below, in rows."""
    rows, line = -(-len(pictures) // columns), 24
    whole = Image.new("RGB", (columns * EDGE, rows * (EDGE + line)), "white")
    font = ImageFont.load_default(size=16)
    for number, (text, picture) in enumerate(pictures.items()):
        x, y = (number % columns) * EDGE, (number // columns) * (EDGE + line)
        whole.paste(as_image(picture), (x, y))
        ImageDraw.Draw(whole).text((x + EDGE // 2, y + EDGE + line // 2), text, "black", font, "mm")
    return whole


def lights() -> None:
    """A bust of bronze in six lights, by the command `jaxprt lights`."""
    names = ("polyhaven_studio_1k.exr", "polyhaven_courtyard_1k.exr", "polyhaven_sunrise_1k.exr")
    names += ("grace_cross.hdr", "stpeters_cross.hdr", "eucalyptus_rnl_cross.hdr")
    files = [DATA / "meshes" / "max_planck_decimated.ply", *(DATA / "env" / name for name in names)]
    material = "metallic-roughness:base_color=.72/.43/.2,metallic=1,roughness=.4"
    path = KEPT / "lights.png"
    options = [
        "--brdf",
        material,
        "--tone",
        "agx",
        "--azimuth",
        "200",
        "--turn",
        "180",
        "--size",
        str(EDGE),
        "--columns",
        "3",
        "--output",
        path,
    ]
    subprocess.run([sys.executable, "-m", "jaxprt", "lights", *files, *options], check=True)
    write("lights", Image.open(path).convert("RGB"))


def small_bust() -> tuple[Shot, prt.RelitScene]:
    """The bust with fewer triangles, as browsers show it, before matte paper and in a light of fewer texels."""
    shot = bust(faces=8_000, edge=45)
    figure, paper = shot.scene.parts
    scene = prt.Scene([figure, prt.Part(paper.name, paper.mesh, matte((0.1, 0.085, 0.075)))], [shot.camera])
    shot = shot._replace(scene=scene, light=resized(shot.light, size=32))
    return shot, prt.precompute(scene, system="lobe", refine=False, size=32, path=KEPT / "live", progress=False)


def live() -> None:
    """A page of the bust, to relight in a browser, by `prt.view.export`."""
    shot, relit = small_bust()
    print(prt.view.export(relit, DOCS / "live.html", environments={"studio": shot.light}, most=MOST_BYTES), flush=True)


def beside() -> None:
    """Puts the bust by jaxprt and the same by Mitsuba into their page with a divider, and the error."""
    shot = bust()
    relit = shot.relit("bust")
    picture = relit.picture(shot.light, shot.camera)
    parts = [(part.mesh, judged(part.material)) for part in shot.scene.parts]
    view = denoised.View(parts, finer(shot.light), shot.camera)
    path = KEPT / "beside.npz"
    truth = denoised.converged(view, noise=0.01, most=1024, block=64, path=path)
    with np.load(path) as kept:
        traced = kept["halves"].mean(0)
    traced = traced[..., :3] / np.maximum(traced[..., 3:], 0.5)  # rays between triangles have seen nothing
    stops = float(relit.exposure(picture, shot.camera))
    images = {"jaxprt": shot.shown(picture, stops), "mitsuba": shot.shown(traced, stops)}
    numbers = {"error": 100 * truth.error(np.asarray(picture)), "noise": 100 * truth.noise, "samples": truth.samples}
    page = (DOCS / "beside.html").read_text()
    for name, image in images.items():
        page = re.sub(f'(<img id="{name}"[^>]* src=")[^"]*', rf"\g<1>{data_address(image)}", page)
    for name, value in numbers.items():
        text = f"{value:,}" if name == "samples" else f"{value:.2g}"
        page = re.sub(f'(<span id="{name}">)[^<]*', rf"\g<1>{text}", page)
    (DOCS / "beside.html").write_text(page)
    print(DOCS / "beside.html", f"{len(page):,} bytes", numbers, flush=True)


def judged(material: TexturedMaterial) -> MetallicRoughness:
    """A material without textures for Mitsuba."""
    return MetallicRoughness(material.base_color, metallic=material.metallic, roughness=material.roughness)


def data_address(image: Image.Image) -> str:
    """An image within a page."""
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode()


PAGES: dict[str, Callable[[], None]] = {"systems": systems, "lights": lights, "live": live, "beside": beside}

if __name__ == "__main__":
    for name in sys.argv[1:] or (*SHOTS, *PAGES):
        PAGES[name]() if name in PAGES else lead(name)
