// Prints where three.js has the vertices of a glTF file in poses of its animations, as JSON: some positions and the mean.
// Lights, if there are any, come last.
// npm install three@0.187 && node three_poses.mjs FILE [NAME@SECONDS ...]; without a name, the first animation.
// three_poses.json is the output for each file of test_gltf_nodes.py, by the name of the file.
import fs from 'node:fs';
import path from 'node:path';
import * as THREE from 'three';
import { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';

globalThis.self = globalThis;
const SHOWN = 12; // positions of each pose
const [, , file, ...poses] = process.argv;

function buffer(bytes) {
  return bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
}

THREE.FileLoader.prototype.load = function (url, onLoad) {
  const embedded = url.startsWith('data:');
  const bytes = embedded ? Buffer.from(url.split(',')[1], 'base64') : fs.readFileSync(path.join(path.dirname(file), url));
  onLoad(buffer(bytes));
};
const loader = new GLTFLoader();
loader.register((parser) => {
  parser.loadTexture = async () => new THREE.Texture();
  return { name: 'no textures' };
});
const content = fs.readFileSync(file);
const gltf = await loader.parseAsync(file.endsWith('.glb') ? buffer(content) : content.toString(), '');

function positions() {
  const found = [];
  gltf.scene.updateMatrixWorld(true);
  gltf.scene.traverse((object) => {
    if (!object.isMesh) return;
    if (object.isSkinnedMesh) object.skeleton.update();
    for (let i = 0; i < object.geometry.attributes.position.count; i++) {
      const vertex = object.getVertexPosition(i, new THREE.Vector3());
      found.push(vertex.applyMatrix4(object.matrixWorld).toArray());
    }
  });
  return found;
}

const result = {};
let mixer;
for (const pose of ['rest', ...poses]) {
  mixer?.stopAllAction(); // puts everything back to where the file has it
  const [name, seconds] = pose.includes('@') ? pose.split('@') : ['', pose];
  if (pose !== 'rest') {
    const clip = name ? THREE.AnimationClip.findByName(gltf.animations, name) : gltf.animations[0];
    mixer = new THREE.AnimationMixer(gltf.scene);
    const action = mixer.clipAction(clip).setLoop(THREE.LoopOnce);
    action.clampWhenFinished = true;
    action.play();
    mixer.setTime(Number(seconds));
  }
  const all = positions();
  const mean = [0, 1, 2].map((axis) => all.reduce((sum, vertex) => sum + vertex[axis], 0) / all.length);
  const step = Math.max(1, Math.floor(all.length / SHOWN));
  const some = all.filter((_, i) => i % step === 0);
  result[pose] = { count: all.length, mean, some: some.map((vertex) => vertex.map((x) => Number(x.toPrecision(7)))) };
}
const lights = [];
gltf.scene.traverse((object) => {
  if (!object.isLight) return;
  const position = object.getWorldPosition(new THREE.Vector3());
  const { name, type, intensity, angle, penumbra } = object;
  const color = object.color.toArray();
  const target = object.target?.getWorldPosition(new THREE.Vector3()).sub(position).normalize().toArray();
  lights.push({ name, type, color, intensity, position: position.toArray(), target, angle, penumbra });
});
if (lights.length) result.lights = lights;
console.log(JSON.stringify(result));
