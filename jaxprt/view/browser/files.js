// Files that are dropped: a scene with all that belongs to it, or lights, or a state.

const MESHES = /\.(glb|gltf|obj|ply|stl|off)$/i; // of files that are scenes
const LIGHTS = /\.(hdr|exr|pic|json)$/i; // what does not belong to scenes
const IMAGES = /\.(png|jpe?g|tiff?|pfm|bmp|webp|ktx2)$/i; // which may be lights

// The files of a drop, with those in folders, each with its place.
export async function droppedFiles(data) {
  const entries = [...data.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  const files = [...data.files].map((file) => ({ place: file.name, file }));
  if (!entries.some((entry) => entry.isDirectory)) return files;
  const inside = [];
  const walk = async (entry) => {
    if (entry.isFile) {
      const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
      return inside.push({ place: entry.fullPath.slice(1), file });
    }
    const reader = entry.createReader();
    for (;;) {
      // browsers tell some at a time
      const some = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
      if (!some.length) return;
      for (const inner of some) await walk(inner);
    }
  };
  for (const entry of entries) await walk(entry);
  return inside;
}

/** @param {import("./viewer.js").Viewer} viewer @param {{ place: string, file: File }[]} files */
export async function openFiles(viewer, files) {
  try {
    const opens = files.some(({ place }) => MESHES.test(place));
    const parts = files.filter(({ place }) => opens && !LIGHTS.test(place));
    for (const dropped of files) if (!parts.includes(dropped)) await openLight(viewer, dropped.file);
    if (!opens) return;
    viewer.fault = "";
    const message = { kind: "open", names: parts.map(({ place }) => place) };
    const scene = parts.map(({ file }) => file);
    await send(viewer, message, scene);
    viewer.scenes.follow();
  } catch (error) {
    viewer.stats.errors++;
    viewer.tell(error.message);
  }
}

// A light, or a state.
async function openLight(viewer, file) {
  const { name } = file;
  if (/\.json$/i.test(name)) {
    const text = await file.text();
    try {
      return viewer.give(text);
    } catch (error) {
      throw new Error(`${name}: ${error.message}`);
    }
  }
  if (!IMAGES.test(name) && !LIGHTS.test(name))
    throw new Error(`${name} must be a scene (GLB, glTF, OBJ, PLY, STL, OFF), a light (HDR, EXR) or a state (JSON)`);
  const { content, buffers } = await send(viewer, { kind: "drop", name }, [file]);
  viewer.scenes.take(content, buffers);
  viewer.set({ light: content.light, lamps: [] });
}

async function send(viewer, message, files) {
  for (const { name, size } of files)
    if (size > 2 ** 29) throw new Error(`${name} must have at most 512 MiB, and has ${Math.ceil(size / 2 ** 20)}`);
  const bytes = await Promise.all(files.map((file) => file.arrayBuffer()));
  const text = `reading ${files.map((file) => file.name).join(", ")}`;
  return viewer.waiting.during("drop", text, viewer.demand(message, bytes), 0);
}
