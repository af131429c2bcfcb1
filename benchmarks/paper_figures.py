"""Pictures for the figures of Sun et al. 2007, from the scenes of `benchmarks.paper_scenes`.

Each figure is a dictionary from titles to pictures in linear radiance, with coverage as fourth channel, made by
changing what the paper's caption says is changed: light, view or material. Pictures are made at pixels: what arrives is
that of the vertices, interpolated; BRDF, view and lobes are the pixel's own. `traced` has Mitsuba's pictures of the
same scenes.

    python -m benchmarks.paper_figures FOLDER [--store FOLDER] [--only FIGURE...]     write them as PNG
"""

import argparse
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from benchmarks import paper_scenes, path_tracing
from benchmarks.paper_recipes import RECIPES, Look
from benchmarks.paper_scenes import Made
from jaxprt import RelitScene, files, image
from jaxprt.brdf import Lambert
from jaxprt.image import raster
from jaxprt.relit.groups import joined_mesh
from jaxprt.scene import Camera, Environment
from jaxprt.scene.environment import background

SAMPLES = 1024  # of Mitsuba's pixels


def picture(
    scene: RelitScene, *, camera: Camera, light: Environment, materials: Mapping[str, Any] | None = None
) -> np.ndarray:
    """A picture of a scene, anti-aliased, in linear radiance before black, with coverage."""
    coverage = scene.coverage(camera)[..., None]
    seen = scene.picture(light, camera, materials=materials)
    sky = (1 - coverage) * background(light, raster.ray_direction(camera))
    return np.asarray(jnp.concatenate([seen - sky, coverage], -1))


def models(made: Made, changed: Look | None = None) -> list[Any]:
    """BRDFs of all regions, for Mitsuba; `changed` is that of `Made.materials`."""
    free = made.materials(changed)
    names = [part.name for part in made.scene.scene.parts]
    return [free.get(name) or Lambert(made.recipe.fixed[int(name)]) for name in names]


def traced(
    made: Made, changed: Look | None = None, *, camera: Camera, bounces: int = 2, samples: int = SAMPLES, seed: int = 0
) -> np.ndarray:
    """Mitsuba's picture of a scene with so many bounces, with the coverage of ours."""
    found = path_tracing.picture(
        joined_mesh(made.scene.shading),
        models(made, changed),
        paper_scenes.light_of(made),
        camera,
        depth=2 + bounces,
        samples=samples,
        seed=seed,
    )
    return np.concatenate([found, made.scene.coverage(camera)[..., None]], -1)


def off(mine: np.ndarray, exact: np.ndarray) -> float:
    """Relative L2 of a picture against another, noise included, over the pixels that the scene fills."""
    inside = (exact[..., 3] == 1) & (mine[..., 3] == 1)
    return float(np.linalg.norm((mine - exact)[inside]) / np.linalg.norm(exact[inside, :3]))


class Figures:
    """The figures of the paper; `quick` makes small ones of small scenes, `store` keeps what is precomputed."""

    def __init__(self, *, quick: bool = False, store: pathlib.Path | None = None):
        """Nothing is computed yet."""
        self.quick, self.store, self.made = quick, store, {}
        self.edge = 16 if quick else paper_scenes.EDGE

    def scene(self, name: str, **options: Any) -> Made:
        """A scene that is ready, made once."""
        key = name, tuple(options.items())
        if key not in self.made:
            self.made[key] = paper_scenes.prepare(name, quick=self.quick, store=self.store, **options)
        return self.made[key]

    def camera(self, made: Made, **options: Any) -> Camera:
        """The camera of a scene."""
        return paper_scenes.camera_of(made.recipe, made.scene.mesh, edge=self.edge, **options)

    def drawn(
        self,
        made: Made,
        changed: Look | None = None,
        *,
        turn: float = 0.0,
        lit: float = 0.0,
        scene: RelitScene | None = None,
    ) -> np.ndarray:
        """A picture with the view or the light turned, other materials, or without a part of the light."""
        light = paper_scenes.turned(paper_scenes.light_of(made), lit)
        camera, scene = self.camera(made, turn=turn), made.scene if scene is None else scene
        return picture(scene, camera=camera, light=light, materials=made.materials(changed))

    def figure_1(self) -> dict[str, np.ndarray]:
        """A bust whose BRDF moves along a curve in the plane of Fresnel reflectance and roughness."""
        made, color = self.scene("bust"), RECIPES["bust"].free[0][0]
        curve = [(0.05, 0.8), (0.2, 0.4), (0.6, 0.2), (1.0, 0.1)]
        shares = [(1.5, 0.3), (1.0, 0.5), (0.5, 0.7), (0.1, 0.85)]
        return {
            f"F0 {f0:g}, m {m:g}": self.drawn(made, {0: (base * np.asarray(color), gloss, [f0, m])})
            for (f0, m), (base, gloss) in zip(curve, shares, strict=True)
        }

    def figure_8(self) -> dict[str, np.ndarray]:
        """One bounce off a ring, by the resolution of the light."""
        found = {}
        for edge in (2, 4) if self.quick else (4, 8, 16):
            # The directory of the finest has two bounces; these are one bounce each.
            made = self.scene("ring", edge=edge, bounces=1)
            whole, direct = self.drawn(made), self.drawn(made, scene=made.scene.without_bounces())
            reflected = np.maximum(whole - direct, 0)
            found[f"6 x {edge} x {edge}"] = np.concatenate([reflected[..., :3], whole[..., 3:]], -1)
        return found

    def figure_11(self) -> dict[str, np.ndarray]:
        """Direct light, and interreflection; `traced` has the first picture of the paper's."""
        made = self.scene("bird")
        return {"direct light": self.drawn(made, scene=made.scene.without_bounces()), "two bounces": self.drawn(made)}

    def figure_12(self) -> dict[str, np.ndarray]:
        """A room: direct light, with bounces, and after adjusting floor, sofa and walls."""
        made = self.scene("room")
        shiny = {0: ([0.1, 0.1, 0.12], 0.6, 200.0)}
        green = {1: ([0.1, 0.45, 0.12], 0.1, 20.0), 0: ([0.5, 0.12, 0.08], 0.2, 60.0)}
        walls = {2: ([0.15, 0.3, 0.6], 0.05, 6.0)}
        return {
            "direct light": self.drawn(made, scene=made.scene.without_bounces()),
            "two bounces": self.drawn(made),
            "shiny dark floor": self.drawn(made, shiny),
            "red floor, green sofa": self.drawn(made, green),
            "blue walls": self.drawn(made, walls),
            "light turned": self.drawn(made, lit=-0.5),
        }

    def figure_13(self) -> dict[str, np.ndarray]:
        """Shininess of a base, above, and of what stands on it, below."""
        made = self.scene("airplane")
        (color, gloss, _), (ground, base, _) = (RECIPES["airplane"].free[number] for number in (0, 1))
        found = {f"base, exponent {n:g}": self.drawn(made, {1: (ground, base, n)}) for n in (6.0, 60.0, 200.0)}
        for n in (6.0, 60.0, 200.0):
            found[f"object, exponent {n:g}"] = self.drawn(made, {0: (color, gloss, n)})
        return found

    def ring(self) -> dict[str, np.ndarray]:
        """Shininess of the ring, with its bounces: direct light and both bounces."""
        made = self.scene("ring")
        color = RECIPES["ring"].free[0][1]
        exponents = (20.0, 60.0, 200.0)
        return {f"exponent {n:g}": self.drawn(made, {0: (0.02, color, n)}) for n in exponents}

    def figure_15(self) -> dict[str, np.ndarray]:
        """Chess with the light behind the board: direct light, and with bounces; then another view and material."""
        made = self.scene("chess")
        gold = {0: ([0.02, 0.02, 0.02], [1.0, 0.76, 0.33], [0.8, 0.2])}
        return {
            "direct light": self.drawn(made, scene=made.scene.without_bounces()),
            "two bounces": self.drawn(made),
            "another view": self.drawn(made, turn=0.5),
            "one side of gold": self.drawn(made, gold),
        }


FIGURES: dict[str, Callable[[Figures], dict[str, np.ndarray]]] = {
    "1": Figures.figure_1,
    "8": Figures.figure_8,
    "11": Figures.figure_11,
    "12": Figures.figure_12,
    "13": Figures.figure_13,
    "ring": Figures.ring,
    "15": Figures.figure_15,
}


def exposed(pictures: dict[str, np.ndarray], *, brighter: float = 0.0) -> dict[str, np.ndarray]:
    """The pictures of a figure for the screen, on white, all with the exposure that the last one asks for."""
    *_, last = pictures.values()
    stops = float(image.automatic_exposure(jnp.asarray(last[..., :3]))) + brighter
    return {title: _on_white(each, stops) for title, each in pictures.items()}


def _on_white(picture: np.ndarray, stops: float) -> np.ndarray:
    """A picture with coverage, clamped for the screen before it is laid over white, so that edges stay smooth."""
    cover = picture[..., 3:]
    color = image.expose(jnp.asarray(picture[..., :3] / np.maximum(cover, 1e-6)), stops=stops)
    return np.asarray(image.display(jnp.asarray(cover) * jnp.clip(color, 0, 1) + 1 - cover))


def main(options: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path, help="where to write the pictures")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what is precomputed, and go on")
    parser.add_argument("--only", nargs="+", choices=list(FIGURES), metavar="FIGURE", help=", ".join(FIGURES))
    parser.add_argument("--quick", action="store_true", help="small pictures of small scenes")
    arguments = parser.parse_args(options)
    figures = Figures(quick=arguments.quick, store=arguments.store)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for name in arguments.only or FIGURES:
        row = np.concatenate(list(exposed(FIGURES[name](figures)).values()), 1)
        files.write_png(arguments.folder / f"figure_{name}.png", row.astype(np.float32))
        print(f"figure {name}", flush=True)


if __name__ == "__main__":
    main()
