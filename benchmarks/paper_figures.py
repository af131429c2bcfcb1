"""Pictures and numbers for the figures of Sun et al. 2007 with reflected light, of scenes of `benchmarks.paper_scenes`.

Each figure is a `Sheet`: pictures in linear radiance with coverage as fourth channel, by their captions, and lines of
what was measured in the region that the paper's statement is about. What is changed is what the paper's caption says:
light, view or material. Pictures are made at pixels: what arrives is that of the vertices, interpolated; BRDF, view and
lobes are the pixel's own. `benchmarks.figures` draws the sheets and writes the lines.
"""

import pathlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from benchmarks import paper_scenes
from benchmarks.figures import drawing
from benchmarks.paper_recipes import RECIPES, Look
from benchmarks.paper_scenes import Made
from benchmarks.path_tracing import Exact
from benchmarks.published import interiors
from jaxprt import image
from jaxprt.scene import Camera, Environment, builtin
from jaxprt.scene.environment import add_disk
from jaxprt.sphere import cubemap

EDGE, SAMPLES = 448, 144  # pixels along the edge of a picture, and samples of Mitsuba's in each of two pictures
LAYERS = ("color", "direct", "reflected", "alpha", "normal", "position", "part")
# Round lamps in dim light from everywhere: direction, radius in degrees, and radiance of the dim light.
LAMPS = {
    "bust": ((-0.55, 0.75, 0.55), 8, 0.05),
    "bird": ((0.5, 1.2, -0.2), 12, 0.05),
    "airplane": ((-0.5, 0.9, 0.6), 12, 0.05),
    "chess": ((-0.35, 0.62, -1.0), 12, 0.02),
    "watch": ((-0.6, 0.9, 0.5), 14, 0.3),
}
BIRD: Look = {0: ([0.75, 0.7, 0.5], 0.1, [0.05, 0.4]), 1: ([0.03, 0.12, 0.75], 0.05, [0.05, 0.4])}
BELOW = ((-0.42, 0.07, 0.42), (0.0, -0.02, 0.0), 0.55)  # a camera that sees the chest of the bird
METALS = {  # specular weights of case and bracelet, and roughness
    "steel": ([0.72, 0.73, 0.76], [0.72, 0.73, 0.76], 0.2),
    "gold": ([1.0, 0.72, 0.28], [1.0, 0.72, 0.28], 0.15),
    "copper and steel": ([0.93, 0.5, 0.35], [0.72, 0.73, 0.76], 0.25),
    "black steel": ([0.12, 0.12, 0.14], [0.12, 0.12, 0.14], 0.35),
}
_RUST, _GOLD = np.array([0.6, 0.14, 0.05]), np.array([1.0, 0.72, 0.28])
SHININESS = 6.0, 60.0, 200.0  # exponents of Figure 13
_STRONGER = 3  # how many times what the bust sends to the walls is shown
_FACING = 0.1  # least cosine by which a surface looks away from the lamp, or down


class Sheet(NamedTuple):
    """A figure.

    Attributes:
        pictures: Pictures [h, w, 4] by their captions: linear radiance before black, and coverage.
        lines: What was measured.
        like: Radiance whose exposure all have; that of the last picture if None.
    """

    pictures: dict[str, np.ndarray]
    lines: list[dict[str, Any]]
    like: np.ndarray | None = None


def soft_box(direction: Any, degrees: float, dim: float, *, size: int) -> Environment:
    """A round lamp in dim light from everywhere.

    Args:
        direction: Direction towards the lamp.
        degrees: Angle from the middle of the lamp to its edge.
        dim: Radiance of the light from everywhere.
        size: Texels along the edge of the light's faces.

    Returns:
        Light in three colors. A white diffuse surface that faces it has a radiance of 1 + dim without shadows.
    """
    angle = np.radians(degrees)
    light = Environment(jnp.full((6, size, size, 3), dim, jnp.float32))
    return add_disk(light, np.asarray(direction, float), angle=float(angle), radiance=float(1 / np.sin(angle) ** 2))


def off(mine: np.ndarray, exact: np.ndarray, where: np.ndarray | None = None) -> float:
    """Relative L2 of a picture against another, noise included, over the pixels that the scene fills.

    `where` has those that count, [h, w]; None for all.
    """
    inside = (exact[..., 3] == 1) & (mine[..., 3] == 1)
    inside = inside if where is None else inside & where
    return float(np.linalg.norm((mine - exact)[inside]) / np.linalg.norm(exact[inside, :3]))


def mean(picture: np.ndarray, where: np.ndarray) -> float:
    """Mean radiance of some pixels, over the colors."""
    return float(np.mean(picture[where][:, :3]))


def share(value: float) -> str:
    """A number as percent."""
    return f"{100 * value:.0f} %" if value >= 0.095 else f"{100 * value:.1f} %"


def _judged(line: dict[str, Any], exact: Exact | None, name: str, picture: np.ndarray, where: np.ndarray) -> str:
    """Adds the errors of a picture to its line, over some pixels and over all, and returns the end of its caption.

    Without Mitsuba's picture, and of that itself, there are none.
    """
    if exact is None or name.startswith("Mitsuba"):
        return ""
    line |= {"error": exact.off(picture, where), "error_whole": exact.off(picture)}
    return f", {share(line['error'])} off"


class Layers(NamedTuple):
    """A picture and what it is made of, by pixel.

    Attributes:
        color: Direct and reflected light, with coverage.
        direct: Direct light alone, with coverage.
        normal: Unit normals, where a surface covers the pixel.
        position: Where that surface is.
        part: Number of the part that covers the pixel; -1 where none does.
    """

    color: np.ndarray
    direct: np.ndarray
    normal: np.ndarray
    position: np.ndarray
    part: np.ndarray

    def region(self, *parts: int, toward: Any = None) -> np.ndarray:
        """Pixels that some parts cover, [h, w]; those that face a direction by a cosine of 0.1 or more."""
        inside = np.isin(self.part, parts) & (self.color[..., 3] == 1)
        if toward is None:
            return inside
        axis = np.asarray(toward, float) / np.linalg.norm(toward)
        return inside & (self.normal @ axis > _FACING)


class Figures:
    """The figures of the paper; `quick` makes small ones of small scenes, `store` keeps what is precomputed.

    `compare` says whether Mitsuba's pictures stand beside ours, with errors against them.
    """

    def __init__(self, *, quick: bool = False, store: pathlib.Path | None = None, compare: bool = False):
        """Nothing is computed yet."""
        self.quick, self.store, self.compare, self.scenes = quick, store, compare, {}
        self.edge, self.samples = (16, 4) if quick else (EDGE, SAMPLES)

    def scene(self, name: str, **options: Any) -> Made:
        """A scene that is ready, made once."""
        key = name, tuple(options.items())
        if key not in self.scenes:
            self.scenes[key] = paper_scenes.prepare(name, quick=self.quick, store=self.store, **options)
        return self.scenes[key]

    def camera(self, ready: Made, **options: Any) -> Camera:
        """The camera of a scene."""
        return paper_scenes.camera_of(ready.recipe, ready.scene.mesh, edge=self.edge, **options)

    def lamp(self, ready: Made) -> Environment:
        """The lamp of a scene."""
        size = ready.scene.light_size
        assert size is not None
        return soft_box(*LAMPS[ready.name], size=size)

    def layers(
        self,
        ready: Made,
        changed: Look | None = None,
        *,
        light: Environment | None = None,
        camera: Camera | None = None,
        rays: int = 0,
    ) -> Layers:
        """A picture with other materials, in the light of the scene's recipe unless another one is given."""
        layers = ready.scene.with_rays(rays).picture(
            paper_scenes.light_of(ready) if light is None else light,
            self.camera(ready) if camera is None else camera,
            materials=ready.materials(changed),
            background=None,
            layers=list(LAYERS),
        )
        layer = {name: np.asarray(value) for name, value in layers.items()}
        alpha = layer["alpha"][..., None]
        color, direct = (np.concatenate([layer[name][..., :3], alpha], -1) for name in ("color", "direct"))
        normal = layer["normal"] / np.maximum(np.linalg.norm(layer["normal"], axis=-1, keepdims=True), 1e-6)
        return Layers(color, direct, normal, layer["position"], layer["part"])

    def mitsuba(self, ready: Made, changed: Look | None = None, **options: Any) -> Exact | None:
        """Mitsuba's picture; None where it is not asked for."""
        if not self.compare:
            return None
        return paper_scenes.traced(ready, changed, samples=self.samples, **options)

    def figure_1(self) -> Sheet:
        """A bust whose BRDF moves along a curve in the plane of Fresnel reflectance and roughness.

        Above the pictures, below what the bust sends to floor and walls: the difference from a black bust.
        """
        ready = self.scene("bust")
        light, camera = self.lamp(ready), self.camera(ready)
        curve = [(0.05, 0.8), (0.2, 0.4), (0.6, 0.2), (1.0, 0.1)]
        shares = [(1.0, 0.3), (0.6, 0.5), (0.25, 0.8), (0.02, 1.0)]
        pictures, sent, lines = {}, {}, []
        black = self.layers(ready, {0: (0.0, 0.0, [0.5, 0.5])}, light=light, camera=camera)
        walls = black.region(1, 2, 3)
        for (f0, m), (diffuse, specular) in zip(curve, shares, strict=True):
            look = (diffuse * _RUST, specular * _GOLD, [f0, m])
            color = self.layers(ready, {0: look}, light=light, camera=camera).color
            pictures[f"F0 {f0:g}, m {m:g}"] = _beside(color, self.ball(look, light, camera))
            reached = np.where(walls[..., None], color[..., :3] - black.color[..., :3], 0)
            first = next(iter(sent.values()))[..., :3] / _STRONGER if sent else reached
            size = np.linalg.norm(black.color[walls][:, :3])
            line = {
                "f0": f0,
                "m": m,
                "sent": float(np.linalg.norm(reached[walls]) / size),
                "changed": float(np.linalg.norm((reached - first)[walls]) / np.linalg.norm(first[walls])),
                "red_over_blue": float(reached[walls][:, 0].sum() / reached[walls][:, 2].sum()),
            }
            lines.append(line)
            caption = f"what it sends, {_STRONGER} times, for m {m:g}\n{share(line['sent'])} of the walls' light"
            sent[caption] = np.concatenate([_STRONGER * np.maximum(reached, 0), black.color[..., 3:]], -1)
        return Sheet({**pictures, **sent}, lines, 2 * next(iter(pictures.values())))

    def ball(self, look: tuple, light: Environment, camera: Camera) -> np.ndarray:
        """An exact picture of a ball of a material without shadows, a quarter as large as other pictures."""
        rings = 8 if self.quick else 48
        mesh = builtin.sphere(rings=rings, sectors=2 * rings)
        away = np.asarray(camera.eye) - np.asarray(camera.target)
        eye, edge = 4.5 * away / np.linalg.norm(away), self.edge // 4
        view = Camera(eye, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.5, edge, edge)
        facing = np.flatnonzero(np.sum(np.asarray(mesh.normal) * (eye - np.asarray(mesh.position)), 1) > 0)
        radiance = drawing.unshadowed(mesh, paper_scenes.model("CT", look), light, eye, facing)
        color = jnp.zeros((len(mesh.position), 4)).at[facing, :3].set(radiance).at[:, 3].set(1)
        return np.asarray(image.render(mesh, color, view, background=None))

    def figure_8(self) -> Sheet:
        """One bounce off a ring, by the resolution of the light that is reflected.

        All come from one tensor: light of few texels is the same radiance in the texels of each of its larger ones.
        """
        ready, pictures, lines = self.scene("ring"), {}, []
        light, camera = paper_scenes.light_of(ready), self.camera(ready)
        assert ready.scene.bounces is not None
        once = eqx.tree_at(lambda relit: relit.bounces.tensor.second, ready.scene, None, is_leaf=lambda x: x is None)
        ready, exact, inside = ready._replace(scene=once), None, None
        if self.compare:
            whole, direct = (self.mitsuba(ready, camera=camera, bounces=n) for n in (1, 0))
            assert whole is not None
            assert direct is not None
            exact = Exact(*(_less(*pair) for pair in zip(whole, direct, strict=True)))
        for edge in (2, 4) if self.quick else (4, 8, 16):
            drawn = self.layers(ready, light=blocks(light, edge), camera=camera)
            picture, inside = _less(drawn.color, drawn.direct), self.inside(drawn)
            line = {"light": f"6 x {edge} x {edge}", "mean": mean(picture, inside), "peak": _peak(picture, inside)}
            caption = f"{line['light']}\nmean {line['mean']:.3f}, peak {line['peak']:.2f}"
            if exact is not None:
                line["error"] = exact.off(picture, inside)
                caption += f", {share(line['error'])} off"
            pictures[caption] = picture
            lines.append(line)
        if exact is not None and inside is not None:
            picture = exact.picture
            line = {"light": "Mitsuba 3", "mean": mean(picture, inside), "peak": _peak(picture, inside)}
            lines.append(line)
            pictures[f"Mitsuba 3, one bounce\nmean {line['mean']:.3f}, peak {line['peak']:.2f}"] = picture
        return Sheet(pictures, lines)

    def inside(self, drawn: Layers) -> np.ndarray:
        """Pixels of the table inside of the ring."""
        return drawn.region(1) & (np.linalg.norm(drawn.position[..., [0, 2]], axis=-1) < interiors.INSIDE)

    def figure_11(self) -> Sheet:
        """A ray tracer, direct light, and interreflection; measured where the bird looks down at the blue ground."""
        ready = self.scene("bird")
        eye, target, angle = BELOW
        recipe = ready.recipe._replace(camera=(eye, target, angle))
        camera = paper_scenes.camera_of(recipe, ready.scene.mesh, edge=self.edge)
        light = self.lamp(ready)
        drawn = self.layers(ready, BIRD, light=light, camera=camera)
        chest = drawn.region(0, toward=(0, -1, 0))
        pictures, lines = {}, []
        exact = self.mitsuba(ready, BIRD, light=light, camera=camera)
        named = {"direct light": drawn.direct, "two bounces": drawn.color}
        if exact is not None:
            named = {"Mitsuba 3, two bounces": exact.picture, **named}
        for name, picture in named.items():
            red, _, blue = np.mean(picture[chest][:, :3], 0)
            line = {"picture": name, "chest": mean(picture, chest), "blue_over_red": float(blue / red)}
            caption = f"{name}\nchest: {line['chest']:.3f}, blue {line['blue_over_red']:.2f} of red"
            caption += _judged(line, exact, name, picture, chest)
            pictures[caption] = picture
            lines.append(line)
        return Sheet(pictures, lines)

    def figure_12(self) -> Sheet:
        """A room: direct light, with bounces, and after adjusting floor, sofa and walls."""
        ready = self.scene("room")
        shiny = {0: ([0.1, 0.1, 0.12], 0.6, 200.0)}
        green = {1: ([0.1, 0.45, 0.12], 0.1, 20.0), 0: ([0.5, 0.12, 0.08], 0.2, 60.0)}
        walls = {2: ([0.15, 0.3, 0.6], 0.05, 6.0)}
        turned = paper_scenes.turned(paper_scenes.light_of(ready), -0.5)
        first = self.layers(ready)
        pictures = {
            "direct light": first.direct,
            "two bounces": first.color,
            "shiny dark floor": self.layers(ready, shiny).color,
            "red floor, green sofa": self.layers(ready, green).color,
            "blue walls": self.layers(ready, walls).color,
            "light turned": self.layers(ready, light=turned).color,
        }
        fixed = first.region(3, 4, 5, 6, 7, 8, 9)  # parts whose materials stay
        lines = [{"picture": name, "changed": off(picture, first.color, fixed)} for name, picture in pictures.items()]
        return Sheet(pictures, lines)

    def figure_13(self) -> Sheet:
        """Shininess of a base, above; of what stands on it, in the middle, and below what that sends to the base."""
        ready = self.scene("airplane")
        light, camera = self.lamp(ready), self.camera(ready)
        pictures, sent, lines = {}, {}, []
        first = None
        for n in SHININESS:
            look = {1: (0.3, 0.5, n)}
            drawn = self.layers(ready, look, light=light, camera=camera, rays=paper_scenes.RAYS)
            first = drawn.color if first is None else first
            line = {"part": "base", "exponent": n, "changed": off(drawn.color, first, drawn.region(0))}
            exact, caption = self.mitsuba(ready, look, light=light, camera=camera), f"base, exponent {n:g}"
            caption += _judged(line, exact, "", drawn.color, drawn.region(0, 1))
            pictures[caption] = drawn.color
            lines.append(line)
        pale = (0.5, 0.0, 20.0)
        dark = {0: (0.0, 0.0, 20.0), 1: pale}
        black = self.layers(ready, dark, light=light, camera=camera)
        base, unlit = black.region(1), self.mitsuba(ready, dark, light=light, camera=camera)
        for n in SHININESS:
            look = {0: (RECIPES["airplane"].free[0][0], 0.6, n), 1: pale}
            color = self.layers(ready, look, light=light, camera=camera, rays=paper_scenes.RAYS).color
            reached = np.where(base[..., None], color[..., :3] - black.color[..., :3], 0)
            line = {"part": "object", "exponent": n, "red_over_blue": _red(reached)}
            exact, caption = self.mitsuba(ready, look, light=light, camera=camera), f"object, exponent {n:g}"
            caption += _judged(line, exact, "", color, base)
            if exact is not None and unlit is not None:
                line["red_over_blue_exact"] = _red((exact.picture - unlit.picture)[base])
            pictures[caption] = color
            caption = f"{n:g}: what it sends, {_STRONGER} times\nred {line['red_over_blue']:.2f} of blue"
            sent[caption] = np.concatenate([_STRONGER * np.maximum(reached, 0), color[..., 3:]], -1)
            lines.append(line)
        return Sheet({**pictures, **sent}, lines, next(iter(pictures.values())))

    def ring(self) -> Sheet:
        """The caustic of Figure 13: exponents of a ring, with direct light and both bounces."""
        ready = self.scene("ring")
        color, camera = RECIPES["ring"].free[0][1], self.camera(ready)
        ours, theirs, lines = {}, {}, []
        for n in (20.0, 60.0, 200.0):
            look = {0: (0.02, color, n)}
            drawn = self.layers(ready, look, rays=paper_scenes.RAYS)
            inside, wall = self.inside(drawn), drawn.region(0)
            line = {"exponent": n, "peak": _peak(drawn.color, inside), "inside": mean(drawn.color, inside)}
            caption = f"exponent {n:g}"
            exact = self.mitsuba(ready, look, camera=camera)
            if exact is not None:
                line |= {"error_inside": exact.off(drawn.color, inside), "error_wall": exact.off(drawn.color, wall)}
                line["error_whole"] = exact.off(drawn.color)
                caption += f"\ninside {share(line['error_inside'])} off, wall {share(line['error_wall'])}"
                theirs[f"exponent {n:g}, Mitsuba 3"] = exact.picture
            ours[caption] = drawn.color
            lines.append(line)
        return Sheet({**ours, **theirs}, lines)

    def figure_14(self) -> Sheet:
        """A watch of four metals, above; below, what it sends to the table: the difference from a black watch."""
        ready = self.scene("watch")
        light, camera = self.lamp(ready), self.camera(ready)
        pictures, glow, lines = {}, {}, []
        black = self.layers(ready, _watch(0.0, 0.0, 0.2), light=light, camera=camera)
        table = black.region(3) & (np.abs(black.position[..., 0]) < 1.6) & (np.abs(black.position[..., 2]) < 2.2)
        for name, (case, bracelet, m) in METALS.items():
            color = self.layers(ready, _watch(case, bracelet, m), light=light, camera=camera).color
            sent = np.where(black.region(3)[..., None], color[..., :3] - black.color[..., :3], 0)
            line = {"metal": name, "m": m, "sent": float(sent[table].sum() / black.color[table][:, :3].sum())}
            line["color"] = [float(value) for value in sent[table].sum(0) / sent[table].sum(0).max()]
            pictures[f"{name}, m {m:g}"] = color
            caption = f"what it sends, {_STRONGER} times, for {name}\n{share(line['sent'])} of the table's light"
            glow[caption] = np.concatenate([_STRONGER * np.maximum(sent, 0), color[..., 3:]], -1)
            lines.append(line)
        return Sheet({**pictures, **glow}, lines, 1.5 * next(iter(pictures.values())))

    def figure_15(self) -> Sheet:
        """Chess with the light behind the board: direct light, and with bounces; measured where pieces look away."""
        ready = self.scene("chess")
        light, camera = self.lamp(ready), self.camera(ready)
        drawn = self.layers(ready, light=light, camera=camera)
        away = drawn.region(0, 1, toward=-np.asarray(LAMPS["chess"][0]))
        exact = self.mitsuba(ready, light=light, camera=camera)
        pictures, lines = {}, []
        named = {"direct light": drawn.direct, "two bounces": drawn.color}
        if exact is not None:
            named |= {"Mitsuba 3, two bounces": exact.picture}
        for name, picture in named.items():
            line = {"picture": name, "away": mean(picture, away)}
            line["brighter"] = line["away"] / mean(drawn.direct, away)
            caption = f"{name}\nsides away from the light: {line['away']:.4f}"
            if picture is not drawn.direct:
                caption += f", {line['brighter']:.1f} times"
            caption += _judged(line, exact, name, picture, away)
            pictures[caption] = picture
            lines.append(line)
        return Sheet(pictures, lines)


FIGURES: dict[str, Callable[[Figures], Sheet]] = {
    "1": Figures.figure_1,
    "8": Figures.figure_8,
    "11": Figures.figure_11,
    "12": Figures.figure_12,
    "13": Figures.figure_13,
    "ring": Figures.ring,
    "14": Figures.figure_14,
    "15": Figures.figure_15,
}


def exposed(
    pictures: Mapping[str, np.ndarray], *, like: np.ndarray | None = None, brighter: float = 0.0
) -> dict[str, np.ndarray]:
    """The pictures of a figure for the screen, on white, all with the exposure of the last one, or of `like`."""
    *_, last = pictures.values()
    color = jnp.maximum(jnp.asarray((last if like is None else like)[..., :3]), 0)
    stops = float(image.automatic_exposure(color)) + brighter
    return {title: _on_white(picture, stops) for title, picture in pictures.items()}


def _on_white(picture: np.ndarray, stops: float) -> np.ndarray:
    """A picture with coverage, clamped for the screen before it is laid over white, so that edges stay smooth."""
    cover = picture[..., 3:]
    color = image.expose(jnp.maximum(jnp.asarray(picture[..., :3] / np.maximum(cover, 1e-6)), 0), stops=stops)
    return np.asarray(image.display(jnp.asarray(cover) * jnp.clip(color, 0, 1) + 1 - cover))


def blocks(light: Environment, edge: int) -> Environment:
    """Light of as many texels whose radiance is that of 6 x edge x edge texels: means over solid angle."""
    size = light.radiance.shape[-2]
    wide = size // edge
    return Environment(jnp.repeat(jnp.repeat(cubemap.reduced(light.radiance, size=edge), wide, 1), wide, 2))


def _less(whole: np.ndarray, part: np.ndarray) -> np.ndarray:
    """A picture less another one of the same coverage; negative values, which are noise, stay."""
    return np.concatenate([whole[..., :3] - part[..., :3], whole[..., 3:]], -1)


def _beside(picture: np.ndarray, ball: np.ndarray) -> np.ndarray:
    """A picture with a small one over its lower right corner."""
    result, cover = picture.copy(), ball[..., 3:]
    corner = result[-len(ball) :, -ball.shape[1] :]
    corner[:] = ball + (1 - cover) * corner
    return result


def _peak(picture: np.ndarray, where: np.ndarray) -> float:
    """The radiance that a thousandth of some pixels exceeds, over the colors."""
    return float(np.quantile(np.mean(picture[where][:, :3], 1), 0.999))


def _red(radiance: np.ndarray) -> float:
    """Red light over blue light, summed over pixels."""
    return float(np.sum(radiance[..., 0], dtype=np.float64) / np.sum(radiance[..., 2], dtype=np.float64))


def _watch(case: Any, bracelet: Any, m: float) -> Look:
    """Case and bracelet of two colors of metal."""
    return {0: (0.0, case, [0.9, m]), 1: (0.0, bracelet, [0.9, m])}
