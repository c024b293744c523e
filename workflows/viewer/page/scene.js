// Renderer, cameras, controls, and the shading that makes depth visible.

import {
  DepthTexture, FloatType, MapControls, Mesh, NearestFilter, OrthographicCamera, PerspectiveCamera, PlaneGeometry, Scene,
  ShaderMaterial, Vector2, Vector3, WebGLRenderTarget, WebGLRenderer,
} from "./vendor.js";

const FIELD_OF_VIEW = 55;

// Eye-dome lighting (Boucheny 2009): a pixel is darker the more its neighbours are in front of it.
const EDL = `
uniform sampler2D colours, depths;
uniform vec2 step_;
uniform float near, far, strength;
uniform bool flat_;
varying vec2 at;
float depthAt(vec2 p) {
  float d = texture2D(depths, p).r;
  if (d >= 1.0) return 0.0;
  return flat_ ? near + d * (far - near) : near * far / (far - d * (far - near));
}
float distance_(float d) { return flat_ ? d / 12.0 : log2(d); }
void main() {
  vec4 own = texture2D(colours, at);
  float depth = depthAt(at);
  if (depth == 0.0) { gl_FragColor = vec4(0.0); return; }
  float sum = 0.0;
  for (int i = 0; i < 8; i++) {
    float angle = float(i) * 0.7853981634;
    float other = depthAt(at + vec2(cos(angle), sin(angle)) * step_);
    if (other > 0.0) sum += max(0.0, distance_(depth) - distance_(other));
  }
  gl_FragColor = vec4(own.rgb * mix(0.35, 1.0, exp(-sum * strength)), 1.0);
}`;

const FULL = `varying vec2 at; void main() { at = uv; gl_Position = vec4(position.xy, 0.0, 1.0); }`;

export class View {
  constructor(canvas, context, changed) {
    this.renderer = new WebGLRenderer({ canvas, context, alpha: true });
    this.renderer.setClearColor(0x000000, 0);
    this.renderer.autoClear = false;
    this.scene = new Scene();
    this.lines = new Scene();
    this.perspective = new PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 1e5);
    this.top = new OrthographicCamera(-1, 1, 1, -1, 0.1, 1e5);
    this.camera = this.perspective;
    this.shading = true;
    this.extent = 100;
    this.fence = null;
    this.took = 0;
    this.controls = {};
    for (const [name, camera] of [["perspective", this.perspective], ["top", this.top]]) {
      camera.up.set(0, 0, 1);
      const controls = new MapControls(camera, canvas);
      controls.enableDamping = false;
      controls.zoomToCursor = true;
      controls.zoomSpeed = 1.6;
      controls.addEventListener("change", changed);
      this.controls[name] = controls;
    }
    this.controls.perspective.maxPolarAngle = 1.53;
    this.controls.top.maxPolarAngle = 0;
    this.controls.top.enableRotate = false;
    this.controls.top.enabled = false;
    this.size = new Vector2();
    this.target = new WebGLRenderTarget(1, 1, { minFilter: NearestFilter, magFilter: NearestFilter });
    this.target.depthTexture = new DepthTexture(1, 1, FloatType);
    this.shade = new ShaderMaterial({
      vertexShader: FULL,
      fragmentShader: EDL,
      depthTest: false,
      depthWrite: false,
      uniforms: {
        colours: { value: this.target.texture }, depths: { value: this.target.depthTexture }, step_: { value: new Vector2() },
        near: { value: 1 }, far: { value: 2 }, strength: { value: 1 }, flat_: { value: false },
      },
    });
    this.screen = new Scene();
    const plane = new Mesh(new PlaneGeometry(2, 2), this.shade);
    plane.frustumCulled = false;
    this.screen.add(plane);
  }

  get isTop() { return this.camera === this.top; }
  get control() { return this.isTop ? this.controls.top : this.controls.perspective; }

  resize(width, height, ratio) {
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.size.set(width, height);
    this.target.setSize(Math.round(width * ratio), Math.round(height * ratio));
    this.perspective.aspect = width / height;
    this.perspective.updateProjectionMatrix();
    const half = this.top.top;
    this.top.left = (-half * width) / height;
    this.top.right = (half * width) / height;
    this.top.updateProjectionMatrix();
  }

  // The whole box in the picture; `margin` are pixels that panels cover.
  fit(low, high, margin) {
    const middle = new Vector3().addVectors(low, high).multiplyScalar(0.5);
    const across = new Vector3().subVectors(high, low);
    this.extent = Math.max(across.length(), 1);
    const width = Math.max(this.size.x - margin.left - margin.right, 80);
    const height = Math.max(this.size.y - margin.top - margin.bottom, 80);
    const perPixel = Math.max(across.x / width, across.y / height) * 1.06 || 0.1;
    const dx = ((margin.right - margin.left) / 2) * perPixel;
    const dy = ((margin.top - margin.bottom) / 2) * perPixel;
    const seen = middle.clone().add(new Vector3(dx, dy, 0));
    const half = (perPixel * this.size.y) / 2;
    this.top.zoom = 1;
    this.top.top = half;
    this.top.bottom = -half;
    this.top.position.set(seen.x, seen.y, high.z + this.extent);
    this.controls.top.target.copy(seen);
    const away = half / Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    this.perspective.position.copy(seen).add(new Vector3(0, -0.62, 0.78).multiplyScalar(away * 0.9));
    this.controls.perspective.target.copy(seen);
    this.resize(this.size.x, this.size.y, this.renderer.getPixelRatio());
    for (const controls of Object.values(this.controls)) controls.update();
  }

  // From above or in perspective, at the same place and scale.
  use(top) {
    if (top === this.isTop) return;
    const from = this.control;
    const halfOf = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    if (top) {
      const away = this.perspective.position.distanceTo(from.target);
      const half = away * halfOf;
      this.top.zoom = 1;
      this.top.top = half;
      this.top.bottom = -half;
      this.top.position.set(from.target.x, from.target.y, from.target.z + this.extent);
      this.camera = this.top;
    } else {
      const away = this.top.top / this.top.zoom / halfOf;
      const direction = this.perspective.position.clone().sub(this.controls.perspective.target).normalize();
      this.perspective.position.copy(from.target).addScaledVector(direction, away);
      this.camera = this.perspective;
    }
    for (const controls of Object.values(this.controls)) {
      controls.target.copy(from.target);
      controls.enabled = controls.object === this.camera;
    }
    this.resize(this.size.x, this.size.y, this.renderer.getPixelRatio());
    this.control.update();
  }

  // Pixels of one metre at the distance of one metre, or anywhere seen from above.
  get perMetre() {
    const height = this.size.y * this.renderer.getPixelRatio();
    return this.isTop ? (height * this.top.zoom) / (2 * this.top.top) : height / (2 * Math.tan((FIELD_OF_VIEW * Math.PI) / 360));
  }

  pan(right, up) {
    const metres = (this.isTop ? this.top.top / this.top.zoom : this.perspective.position.distanceTo(this.control.target) * 0.5) * 0.16;
    const forward = new Vector3().setFromMatrixColumn(this.camera.matrix, 1).setZ(0).normalize();
    const side = new Vector3().setFromMatrixColumn(this.camera.matrix, 0).setZ(0).normalize();
    const step = side.multiplyScalar(right * metres).addScaledVector(forward, up * metres);
    this.camera.position.add(step);
    this.control.target.add(step);
    this.control.update();
  }

  clip() {
    if (this.isTop) {
      this.top.near = 0.1;
      this.top.far = 4 * this.extent;
    } else {
      const away = this.perspective.position.distanceTo(this.control.target);
      this.perspective.near = Math.max(0.05, Math.min(away * 0.01, 20));
      this.perspective.far = away + 3 * this.extent;
    }
    this.camera.updateProjectionMatrix();
  }

  draw() {
    const { renderer, shade } = this;
    this.clip();
    this.camera.updateMatrixWorld();
    if (this.shading) {
      renderer.setRenderTarget(this.target);
      renderer.clear();
      renderer.render(this.scene, this.camera);
      const ratio = renderer.getPixelRatio();
      renderer.setRenderTarget(null);
      renderer.clear();
      shade.uniforms.step_.value.set(1.2 / this.size.x, 1.2 / this.size.y).multiplyScalar(Math.max(1, 1.5 / ratio));
      shade.uniforms.near.value = this.camera.near;
      shade.uniforms.far.value = this.camera.far;
      shade.uniforms.flat_.value = this.isTop;
      shade.uniforms.strength.value = this.isTop ? 1.2 : 12.0;
      renderer.render(this.screen, this.camera);
    } else {
      renderer.setRenderTarget(null);
      renderer.clear();
      renderer.render(this.scene, this.camera);
    }
    renderer.render(this.lines, this.camera);
    this.watch();
  }

  // The card is told to say when it has drawn this picture; it works on its own, behind the calls above.
  watch() {
    const gl = this.renderer.getContext();
    if (this.fence) gl.deleteSync(this.fence);
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    this.began = performance.now();
  }

  // Milliseconds that the last picture took; null while it is being drawn.
  drawingTook() {
    if (!this.fence) return this.took;
    const gl = this.renderer.getContext();
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED) return null;
    gl.deleteSync(this.fence);
    this.fence = null;
    this.took = performance.now() - this.began;
    return this.took;
  }

  // Where a point of the map is on the screen, CSS pixels; null behind the camera.
  project(point) {
    const p = point.clone().project(this.camera);
    if (p.z > 1 || p.z < -1) return null;
    return { x: ((p.x + 1) / 2) * this.size.x, y: ((1 - p.y) / 2) * this.size.y };
  }
}
