// What scene.js needs of three.js.
export {
  AmbientLight, BufferAttribute, BufferGeometry, CanvasTexture, Color, CylinderGeometry,
  DirectionalLight, DoubleSide, Group, Line, LineBasicMaterial, LineLoop, Mesh,
  MeshLambertMaterial, NearestFilter, PerspectiveCamera, Raycaster, SRGBColorSpace, Scene, Sprite,
  SpriteMaterial, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
