"""Buffer views of glTF files that meshoptimizer compressed: EXT_meshopt_compression and KHR_meshopt_compression."""

from typing import Any

from jaxprt.scene.formats.gltf_header import Header, excerpt

NAMES = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MODES = ("ATTRIBUTES", "TRIANGLES", "INDICES")
_FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR")
_WIDEST = 256  # bytes of an element
# Decoded bytes of one compressed byte: the vertex codec packs 256 bytes of equal values into 2 bits.
_MOST = 1024


def extension(header: Header, view: dict[str, Any], name: str) -> dict[str, Any] | None:
    """The extension of a buffer view; None if it is not compressed."""
    extensions = header.object(view, "extensions", name)
    used = [key for key in NAMES if key in extensions]
    return header.object(extensions, used[0], name) if used else None


def is_fallback(header: Header, buffer: dict[str, Any], name: str) -> bool:
    """Whether a buffer only stands in for compressed data and has no bytes."""
    extensions = header.object(buffer, "extensions", name)
    stated = any(header.object(extensions, key, name).get("fallback") is True for key in NAMES if key in extensions)
    return stated and "uri" not in buffer


def decoded(document: Header, view: dict[str, Any], extension: dict[str, Any], content: memoryview, name: str) -> bytes:
    """The bytes of a compressed buffer view.

    Args:
        document: The file.
        view: The buffer view.
        extension: Its extension.
        content: The compressed bytes.
        name: Name of the view, for messages.

    Raises:
        ImportError: The package meshopt is missing.
        ValueError: The data are damaged, or their size differs from that of the view.
        MemoryError: The decoded data do not fit into memory.
    """
    owner = f"{NAMES[0]} of {name}" if NAMES[0] in view["extensions"] else f"{NAMES[1]} of {name}"
    count, stride = (document.integer(extension, key, owner) for key in ("count", "byteStride"))
    mode, words = extension.get("mode"), extension.get("filter", "NONE")
    if mode not in _MODES or words not in _FILTERS:
        must = f"must have one of the modes {', '.join(_MODES)} and of the filters {', '.join(_FILTERS)} in {owner}"
        raise document.error(must, f"{excerpt(mode)} and {excerpt(words)}")
    right = 0 < stride <= _WIDEST and stride % 4 == 0 if mode == "ATTRIBUTES" else stride in (2, 4)
    if not right:
        must = "multiples of 4 up to 256 bytes" if mode == "ATTRIBUTES" else "2 or 4 bytes"
        raise document.error(f"must have elements of {must} in {owner}", f"{stride} bytes")
    size = document.integer(view, "byteLength", name)
    if count * stride != size:
        got = f"{count} elements of {stride} bytes"
        raise document.error(f"must have {size} decoded bytes in {owner}, as in the buffer view", got)
    document.decoding(size, len(content), owner, most=_MOST)
    try:
        import meshopt
    except ImportError as error:
        raise ImportError(
            f"{document.path} has compressed geometry ({owner}), which needs the package meshopt: "
            "pip install 'jaxprt[web]'"
        ) from error
    try:
        return meshopt.decode_gltf_buffer(bytes(content), count, stride, mode, words).tobytes()
    except (ValueError, RuntimeError) as error:
        raise document.error(f"must have undamaged data of meshoptimizer in {owner}", str(error)) from error
