"""The extensions of glTF files that are read, and the refusal of files that cannot be read without others."""

from jaxprt.scene.formats import gltf_meshopt
from jaxprt.scene.formats.gltf_draco import DRACO
from jaxprt.scene.formats.gltf_header import Header

INSTANCING = "EXT_mesh_gpu_instancing"
# Compressed data are decoded where they have no uncompressed fallback.
_COMPRESSION = {DRACO, *gltf_meshopt.NAMES, "KHR_texture_basisu", "EXT_texture_webp"}
HONORED = {
    *(
        f"KHR_materials_{name}"
        for name in ("ior", "specular", "anisotropy", "emissive_strength", "clearcoat", "sheen", "transmission")
    ),
    "KHR_texture_transform",
    "KHR_mesh_quantization",
    INSTANCING,
    "KHR_lights_punctual",
    *_COMPRESSION,
}
# What jaxprt draws is right without these: the default variant, the finest level of detail, and no metadata.
_HARMLESS = {"KHR_materials_variants", "MSFT_lod", "KHR_xmp", "KHR_xmp_json_ld"}
_LOOK = "KHR_materials_"  # what a file looks like without these is named in a warning
_NOT_GEOMETRY = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_")


def unread(header: Header) -> set[str]:
    """Names of the extensions that a file uses or requires, except those that are read.

    Extensions of materials are left out: the reader of materials names those that a material of the scene has.
    """
    names = (
        name
        for key in ("extensionsUsed", "extensionsRequired")
        for name in header.strings(header.header, key, "the file")
    )
    return {name for name in names if not name.startswith(_LOOK)} - HONORED


def check_required(header: Header, *, geometry: bool) -> None:
    """Refuses a file that requires extensions that are not read.

    Args:
        header: The file.
        geometry: Whether only the geometry is read, so that extensions of materials, textures and lights do not matter.

    Raises:
        ValueError: The file requires other extensions. The message names them.
    """
    required = set(header.strings(header.header, "extensionsRequired", "the file"))
    unknown = sorted(name for name in required - HONORED - _HARMLESS if not name.startswith(_LOOK))
    if geometry:
        unknown = [name for name in unknown if not name.startswith(_NOT_GEOMETRY)]
    if unknown:
        known = ", ".join(sorted(HONORED))
        raise header.error(f"must not require extensions other than {known}", ", ".join(unknown))
