"""Every argument of every public verb, given values of other kinds and sizes: a finite result, or an error by name.

To add a verb, add a line to ``VERBS``: its arguments with right values. Each argument in turn is replaced by each of
``HOSTILE``. ``OTHER`` has the words by which an error may name an argument, where these are not the argument's name.
"""

import functools
import pathlib
import traceback
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxprt as prt

SIZE = 8
PACKAGE = str(pathlib.Path(prt.__file__).parent)


class Strange:
    """An object of no use."""

    def __repr__(self) -> str:
        return "<a strange object>"


def nothing() -> None:
    """A function of no use."""


HOSTILE: dict[str, Any] = {
    "None": None,
    "NaN": float("nan"),
    "infinity": float("inf"),
    "-1": -1,
    "0": 0,
    "1e38": 1e38,
    "1e-38": 1e-38,
    "1e300": 1e300,
    "2^63": 2**63,
    "2^70": 2**70,
    "truth": True,
    "text": "x",
    "bytes": b"x",
    "1j": 1j,
    "[]": [],
    "{}": {},
    "[None]": [None],
    "ragged": [[1.0], [1.0, 2.0]],
    "object": Strange(),
    "masked": np.ma.masked_array(np.ones((3, 3)), np.eye(3) > 0),
    "path": pathlib.Path("x"),
    "function": nothing,
    "NaN array": np.full((3,), np.nan),
    "empty array": np.zeros((0, 3)),
    "vector of seven": np.ones(7),
    "four axes": np.ones((2, 3, 4, 5)),
    "text array": np.array(["a", "b", "c"]),
    "truth array": np.ones(3, bool),
    "complex array": np.ones((6, SIZE, SIZE, 3), complex),
    "object array": np.array([1, None, "x"], object),
}
ERRORS = TypeError, ValueError, OSError, MemoryError


class Verb:
    """A function, and right values of its arguments.

    ``keep`` names arguments that accept anything, and ``right`` those for which None is right and takes long.
    """

    def __init__(
        self, function: Callable, *, keep: tuple[str, ...] = (), right: tuple[str, ...] = (), **arguments: Any
    ):
        self.function, self.keep, self.right, self.arguments = function, keep, right, arguments

    def call(self, **changed: Any) -> Any:
        """Calls the function, some arguments replaced."""
        return self.function(**{**self.arguments, **changed})


@functools.cache
def mesh() -> prt.scene.Mesh:
    ball = trimesh.creation.icosahedron()
    return prt.scene.mesh.make_mesh(ball.vertices, ball.faces)


LIGHT = np.ones((6, SIZE, SIZE, 3), np.float32)
EYE = [0.0, 1.0, 4.0]


@functools.cache
def environment() -> prt.Environment:
    return prt.Environment(LIGHT)


@functools.cache
def camera() -> prt.Camera:
    return prt.scene.camera.orbit(mesh(), width=8, height=8)


def material() -> prt.scene.TexturedMaterial:
    return prt.scene.TexturedMaterial(base_color=0.5, metallic=0.0, roughness=0.8)


def scene(lamp: bool = False) -> prt.Scene:
    part = prt.Part("ball", mesh(), material())
    lamps = [prt.scene.PointLight("lamp", [0, 3, 0])] if lamp else []
    return prt.Scene([part], [camera()], [environment()], lamps)


@functools.cache
def relit(system: str) -> prt.RelitScene:
    return prt.precompute(scene(), refine=False, system=system, size=SIZE, progress=False)


def methods(relit: prt.RelitScene, name: str) -> dict[str, Verb]:
    """The methods of a precomputed scene."""
    return {
        f"{name}.radiance": Verb(relit.radiance, environment=environment(), eye=EYE, materials=None),
        f"{name}.light": Verb(relit.light, environment=environment()),
        f"{name}.view": Verb(relit.view, eye=EYE, materials=None),
        f"{name}.shade": Verb(relit.shade, light=relit.light(environment()), materials=None),
        f"{name}.combine": Verb(
            relit.combine, light=relit.shade(relit.light(environment())), view=relit.view(jnp.asarray(EYE))
        ),
        f"{name}.appearances": Verb(relit.appearances, materials={"ball": material()}),
        f"{name}.part": Verb(lambda ball: relit.appearances({"ball": ball}), ball=material()),
        f"{name}.picture": Verb(
            relit.picture, environment=environment(), camera=camera(), materials=None, samples=1, between=None
        ),
        f"{name}.coverage": Verb(relit.coverage, camera=camera(), samples=1),
        f"{name}.exposure": Verb(
            relit.exposure, picture=np.ones((camera().height, camera().width, 3)), camera=camera()
        ),
        f"{name}.picture_view": Verb(relit.picture_view, camera=camera(), materials=None, samples=1),
        f"{name}.with_rays": Verb(relit.with_rays, rays=8),
        f"{name}.points": Verb(
            functools.partial(relit.view, jnp.asarray(EYE)),
            points=[prt.scene.points.on_triangles(mesh().face, [0], [[0.2, 0.3, 0.5]])],
        ),
        f"{name}.report": Verb(lambda environments: relit.report(environments), environments=[environment()]),
    }


def constructors() -> dict[str, Verb]:
    """Classes that users fill."""
    here, image = mesh(), np.ones((4, 4, 3), np.float32)
    full = {name: getattr(here, name) for name in ("position", "face", "normal", "tangent", "region")}
    color = prt.scene.Texture(image)
    result = {
        "Environment": Verb(prt.Environment, radiance=LIGHT),
        "Camera": Verb(prt.Camera, eye=EYE, target=[0.0, 0, 0], up=[0, 1, 0], field_of_view=0.6, width=8, height=8),
        "orbit": Verb(
            prt.scene.camera.orbit, mesh=here, azimuth=0.1, elevation=0.2, field_of_view=0.6, width=8, height=8
        ),
        "Mesh": Verb(prt.scene.Mesh, **full, texture=np.zeros((12, 2), np.float32)),
        "make_mesh": Verb(
            prt.scene.mesh.make_mesh,
            position=here.position,
            face=here.face,
            normal=None,
            tangent=None,
            region=None,
            texture=None,
        ),
        "Part": Verb(
            prt.Part,
            name="ball",
            mesh=here,
            material=material(),
            color=np.ones((12, 3)),
            second=np.ones((12, 2)),
            handedness=np.ones(12),
        ),
        "Scene": Verb(
            prt.Scene,
            parts=[prt.Part("ball", here, material())],
            cameras=[camera()],
            environments=[environment()],
            point_lights=[],
        ),
        "PointLight": Verb(prt.scene.PointLight, name="lamp", position=[0, 3, 0], intensity=1.0),
        "Texture": Verb(prt.scene.Texture, image=image, transform=np.eye(2, 3), set=0, wrap=("repeat", "repeat")),
        "TexturedMaterial": Verb(
            prt.scene.TexturedMaterial,
            base_color=0.5,
            metallic=0.0,
            roughness=0.8,
            emissive=0.0,
            ior=1.5,
            specular=1.0,
            specular_color=1.0,
            anisotropy=0.0,
            rotation=0.0,
            normal_scale=1.0,
            base_color_texture=color,
            normal_texture=color,
        ),
        "Blend": Verb(prt.Blend, weight=np.ones((12, 1, 3)), parameter=(np.ones(12),)),
        "Picture": Verb(_pictured, image=np.ones((8, 8, 3)), mask=None, exposure=1.0, saturation=None, camera=camera()),
    }
    for name, values in {
        "Lambert": {"albedo": 0.5},
        "Phong": {"diffuse": 0.5, "specular": 0.3, "exponent": 20.0},
        "BlinnPhong": {"diffuse": 0.5, "specular": 0.3, "exponent": 20.0},
        "AshikhminShirley": {"diffuse": 0.5, "specular": 0.3, "nu": 10.0, "nv": 20.0},
        "Ward": {"diffuse": 0.5, "specular": 0.3, "along": 0.2, "across": 0.3},
        "WardDuer": {"diffuse": 0.5, "specular": 0.3, "along": 0.2, "across": 0.3},
        "CookTorrance": {"diffuse": 0.5, "specular": 0.3, "roughness": 0.3, "f0": 0.5},
        "Lafortune": {"diffuse": 0.5, "cx": [-1.0], "cy": [-1.0], "cz": [1.0], "exponent": [20.0]},
        "GGX": {"f0": 0.5, "roughness": 0.3, "rotation": 0.0},
        "GGXInterface": {"eta": 1.5, "k": 0.0, "roughness": 0.3},
        "SchlickDiffuse": {"albedo": 0.5},
        "MetallicRoughness": {
            "base_color": 0.5,
            "metallic": 0.0,
            "roughness": 0.5,
            "ior": 1.5,
            "specular": 1.0,
            "specular_color": 1.0,
            "anisotropy": 0.0,
            "rotation": 0.0,
        },
        "PoulinFournier": {"diffuse": 0.3, "specular": 0.5, "exponent": 20.0, "distance": 2.0, "height": 0.0},
    }.items():
        result[name] = Verb(functools.partial(_values, getattr(prt.brdf, name)), **values)
    return result


def _pictured(**given: Any) -> Any:
    """A picture that a fit uses."""
    return prt.inverse.observe(mesh(), [prt.inverse.Picture(**given)])


def _values(model: Callable, **parameter: Any) -> Any:
    """A model; without its values, since each shape of the parameters would be compiled."""
    return model(**parameter)


class _CheckedError(Exception):
    """Ends a precomputation when all its arguments are checked."""


def _precompute(**given: Any) -> None:
    """`jaxprt.precompute` up to its first rays."""

    def stop(*arguments: Any, **options: Any) -> None:
        raise _CheckedError

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prt.relit.build, "shaded", stop)
        try:
            prt.precompute(**given)
        except _CheckedError:
            return


def scene_verbs() -> dict[str, Verb]:
    """Verbs of scenes."""
    here = scene()
    common = {"system": "harmonic", "size": SIZE, "progress": False}
    ready = relit("harmonic")
    return {
        "precompute": Verb(
            _precompute,
            keep=("progress",),
            right=("system",),
            scene=here,
            error=None,
            environments=None,
            rate=30.0,
            bounces=None,
            rays=8,
            path=None,
            executor=None,
            refine=False,  # Meshes are divided before the other arguments are looked at.
            **common,
        ),
        "plan": Verb(  # Right values take minutes.
            prt.plan,
            keep=("error", "rate", "path", "progress"),
            right=("environments",),
            scene=here,
            environments=[environment()],
            error=0.3,
            rate=30.0,
            path=None,
            progress=False,
        ),
        "refine": Verb(
            prt.refine, keep=("progress",), scene=here, error=0.5, vertices=12, environments=None, progress=False
        ),
        "radiance": Verb(
            prt.radiance,
            system=ready.part_system(0),
            environment=environment(),
            eye=EYE,
            materials=ready.shading[0].blend,
        ),
        "memory": Verb(prt.memory, system=ready),
        "total": Verb(lambda system: prt.total(system, system), system=ready.part_system(0)),
        "shard": Verb(prt.shard, value=ready, devices=jax.devices()[:1]),
        "load_environment": Verb(prt.load_environment, path="missing.hdr"),
        "environment_from_image": Verb(
            prt.scene.environment.environment_from_image, image=np.ones((4, 8, 3)), size=4, layout=None
        ),
        "load_mesh": Verb(prt.load_mesh, path="missing.obj"),
        "load_scene": Verb(prt.load_scene, path="missing.gltf"),
        "files.load": Verb(prt.files.load, path="missing"),
        "files.read_image": Verb(prt.files.read_image, path="missing.png"),
        "reference.radiance": Verb(
            prt.reference.radiance,
            keep=("progress", "error"),
            right=("occluder", "vertex"),
            mesh=mesh(),
            brdf=prt.brdf.Lambert(0.5),
            light=environment(),
            eye=EYE,
            occluder=None,
            vertex=[0],
            points=prt.scene.points.VERTICES,
            error=1e-2,
            progress=False,
            between=None,
        ),
        "environment.rotate": Verb(
            prt.scene.environment.rotate, light=environment(), rotation=np.eye(3, dtype=np.float32), samples=1
        ),
        "environment.background": Verb(prt.scene.environment.background, light=environment(), direction=EYE),
        "environment.sky": Verb(prt.scene.environment.sky, light=environment(), direction=EYE, angle=0.1),
        "environment.add_disk": Verb(
            prt.scene.environment.add_disk, light=environment(), direction=EYE, angle=0.1, radiance=1.0
        ),
        "environment.finer": Verb(prt.scene.environment.finer, light=environment(), size=8),
        "probes.sample": Verb(
            prt.relit.probes.sample,
            right=("materials",),
            scene=ready,
            environment=environment(),
            positions=[EYE],
            materials=None,
            size=1,
        ),
        "divide": Verb(prt.scene.subdivision.divide, scene=here, edge=2.0),
        "simplify": Verb(prt.scene.occluder.simplify, mesh=mesh(), faces=8),
        "mesh.join": Verb(prt.scene.mesh.join, meshes=[mesh()]),
        "mesh.split": Verb(prt.scene.mesh.split, mesh=mesh()),
        "mesh.rotate": Verb(prt.scene.mesh.rotate, mesh=mesh(), rotation=np.eye(3)),
        "mesh.brush": Verb(prt.scene.mesh.brush, mesh=mesh(), direction=[1, 0, 0]),
        "mesh.ground_plane": Verb(prt.scene.mesh.ground_plane, mesh=mesh(), vertices=16, extent=4.0),
        "view.view": Verb(prt.view.Session, systems=ready, environments={"one": environment()}),
        "view.export": Verb(  # Right values take seconds; the viewer above checks environments in the same way.
            prt.view.export, keep=("environments",), scene=ready, path="/missing/x.html", environments=None, most=1e9
        ),
        "view.export_gltf": Verb(
            prt.view.export_gltf, scene=ready, path="x.glb", environments={"one": environment()}, degree=2
        ),
        "view.export_baked": Verb(
            prt.view.export_baked, scene=ready, path="x.glb", environment=environment(), eye=EYE, materials=None
        ),
        "inverse.observe": Verb(
            prt.inverse.observe, mesh=mesh(), pictures=[prt.inverse.Picture(np.ones((8, 8, 3)), camera())]
        ),
        "inverse.smoothness": Verb(prt.inverse.smoothness, radiance=LIGHT),
    }


def image_verbs() -> dict[str, Verb]:
    """Verbs of pictures."""
    image = np.full((8, 8, 3), 0.5, np.float32)
    return {
        "expose": Verb(prt.image.expose, radiance=image, stops=1.0),
        "automatic_exposure": Verb(
            prt.image.automatic_exposure, image=image, coverage=image[..., 0], percentile=99.0, white=0.9
        ),
        "encode_srgb": Verb(prt.image.encode_srgb, linear=image),
        "decode_srgb": Verb(prt.image.decode_srgb, encoded=image),
        "display": Verb(prt.image.display, radiance=image, tone="agx", stops=1.0),
        "psnr": Verb(prt.image.psnr, image=image, reference=image * 0.9, peak=1.0),
        "relative_l2": Verb(prt.image.relative_l2, image=image, reference=image * 0.9),
        "rasterize": Verb(prt.image.rasterize, mesh=mesh(), camera=camera(), samples=1),
        "render": Verb(
            prt.image.render,
            mesh=mesh(),
            color=np.ones((12, 3), np.float32),
            camera=camera(),
            background=None,
            samples=1,
        ),
        "write_png": Verb(prt.files.write_png, path="/missing/x.png", image=image),
        "write_exr": Verb(prt.files.write_exr, path="/missing/x.exr", image=image),
    }


def system_verbs() -> dict[str, Verb]:
    """Precomputation and relighting functions of the systems."""
    here, model = mesh(), prt.brdf.Lambert(0.5)
    common = {"mesh": here, "size": SIZE, "occluder": None, "vertex": None}
    quiet = {"run": prt.Run(progress=False)}
    return {
        "Run": Verb(prt.Run, keep=("progress",), path="missing", executor=None, progress=True),
        "harmonic.precompute": Verb(prt.harmonic.precompute, degree=2, **common, **quiet),
        "harmonic.precompute_diffuse": Verb(prt.harmonic.precompute_diffuse, degree=2, **common, **quiet),
        "harmonic.tabulate": Verb(
            prt.harmonic.tabulate, keep=("error",), brdf=model, degree=2, error=0.5, resolution=None, knot=()
        ),
        "harmonic.project": Verb(prt.harmonic.project, light=environment(), degree=2),
        "lobe.precompute": Verb(prt.lobe.precompute, **common, **quiet),
        "lobe.blurred_light.prefilter": Verb(prt.lobe.blurred_light.prefilter, light=environment()),
        "lobe.tabulate": Verb(prt.lobe.tabulate, brdf=model, lobes=1, error=None, resolution=8, knot=()),
        "separable.factor": Verb(prt.separable.factor, brdf=model, terms=1, error=None, light=None, resolution=8),
        "separable.system.project": Verb(prt.separable.system.project, light=environment()),
        "lamps.precompute": Verb(
            prt.lamps.precompute,
            lamps=[prt.scene.PointLight("lamp", [0, 3, 0])],
            samples=4,
            pieces=1,
            **{name: value for name, value in common.items() if name != "size"},
            **quiet,
        ),
        "bright_texels.split": Verb(prt.bright_texels.split, light=environment(), count=4),
        "bright_texels.samples_for": Verb(prt.bright_texels.samples_for, brdf=model, size=SIZE, error=0.1),
    }


def broken(result: Any) -> bool:
    """Whether a result holds NaN."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(result) if isinstance(leaf, jax.Array | np.ndarray | float)]
    return any(np.isnan(leaf.astype(np.float64)).any() for leaf in leaves if leaf.dtype.kind == "f")


def offense(verb: Verb, argument: str, value: Any) -> str | None:
    """What is wrong with the result, or with the error, of a call with one strange value; None if it is right."""
    words = OTHER.get(argument, (argument, argument.replace("_", " ")))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = verb.call(**{argument: value})
            return "NaN" if broken(result) else None
    except ERRORS as error:
        raised = traceback.extract_tb(error.__traceback__)[-1].filename
        first = str(error).split("\n")[0]
        if not raised.startswith(PACKAGE) and not isinstance(error, OSError):
            return f"{type(error).__name__} out of {pathlib.Path(raised).name}: {first}"
        return None if any(word in first for word in words) else f"an error without a name: {first}"
    except Exception as error:
        return f"{type(error).__name__}: {error}".split("\n")[0]


OTHER: dict[str, tuple[str, ...]] = {
    "count": ("number of texels",),
    "lamps": ("lamp",),
    "parts": ("part",),
    "width": ("width", "picture"),
    "height": ("height", "picture"),
    "field_of_view": ("field_of_view", "camera"),
    "position": ("position", "mesh"),
    "environment": ("light",),
    "environments": ("environment", "light"),
    "materials": ("material",),
    "material": ("material", "BRDF"),
    "ball": ("material", "emit"),
    "brdf": ("BRDF",),
    "point_lights": ("point_lights", "point light", "two"),
    "cameras": ("camera",),
    "systems": ("system", "scene"),
    "value": ("value", "transport"),
    "pictures": ("picture",),
    "image": ("image", "picture", "pixel"),
    "edge": ("edge", "triangles"),
    "mask": ("mask",),
    "light": ("light",),
    "positions": ("positions",),
    "most": ("most", "folder"),
    "saturation": ("saturation", "pixel"),
    "exposure": ("exposure",),
    "weight": ("weight",),
    "background": ("background",),
    "system": ("system",),
    "path": ("path", "missing", "/x", "x must", "dictionary of Mitsuba"),
    "meshes": ("mesh",),
    "radiance": ("radiance", "light"),
    "set": ("set",),
    "reference": ("reference", "images must"),
}


def offenses(name: str, verb: Verb) -> Iterator[str]:
    """All offenses of a verb."""
    for argument in verb.arguments:
        if argument in verb.keep:
            continue
        for label, value in HOSTILE.items():
            if value is None and argument in verb.right:
                continue
            found = offense(verb, argument, value)
            if found:
                yield f"{name}({argument}={label}): {found}"


TABLES = {
    "constructors": constructors,
    "scenes": scene_verbs,
    "pictures": image_verbs,
    "systems": system_verbs,
    "precomputed": lambda: methods(relit("harmonic"), "relit"),
}


@pytest.mark.usefixtures("unchecked", "coarse")
@pytest.mark.parametrize("table", TABLES)
def test_strange_values_end_in_a_result_or_an_error_by_name(table, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = [each for name, verb in TABLES[table]().items() for each in offenses(name, verb)]
    assert not found, "\n".join(found)
