// What the relight panel needs of three.js; bundled by the command in docs/report.md.
export {
  Box3,
  DataTexture,
  EquirectangularReflectionMapping,
  Euler,
  Group,
  HalfFloatType,
  LinearFilter,
  LinearSRGBColorSpace,
  NeutralToneMapping,
  PMREMGenerator,
  PerspectiveCamera,
  Quaternion,
  Scene,
  Sphere,
  WebGLRenderer,
} from "three";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
export { HDRLoader } from "three/examples/jsm/loaders/HDRLoader.js";
