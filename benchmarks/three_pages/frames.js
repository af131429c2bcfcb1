// Renders a scene of three.js into floats: linear radiance and alpha, and the milliseconds of some frames. The camera's
// place is in the axes of a model of the scene.
export function frames(THREE, renderer, scene, { edge, frames, eye, target, up, angle }, model = scene) {
  const distance = new THREE.Vector3(...eye).distanceTo(new THREE.Vector3(...target));
  const camera = new THREE.PerspectiveCamera(angle, 1, distance / 100, 100 * distance);
  camera.up.set(...up);
  camera.position.set(...eye);
  camera.lookAt(...target);
  model.add(camera);
  scene.background = null;
  renderer.setClearColor(0, 0);
  const buffer = new THREE.WebGLRenderTarget(edge, edge, { type: THREE.FloatType });
  const data = new Float32Array(4 * edge * edge);
  const milliseconds = [];
  renderer.setRenderTarget(buffer);
  for (let frame = -1; frame < frames; frame++) {
    const start = performance.now();
    renderer.render(scene, camera);
    renderer.readRenderTargetPixels(buffer, 0, 0, 1, 1, new Float32Array(4));
    if (frame >= 0) milliseconds.push(performance.now() - start);
  }
  renderer.readRenderTargetPixels(buffer, 0, 0, edge, edge, data);
  return { data: text(data), milliseconds };
}

// Floats as base64.
export function text(data) {
  const bytes = new Uint8Array(data.buffer);
  let result = "";
  for (let first = 0; first < bytes.length; first += 32768) result += String.fromCharCode(...bytes.subarray(first, first + 32768));
  return btoa(result);
}
