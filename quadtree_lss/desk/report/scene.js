// SPDX-License-Identifier: Apache-2.0
// 3D view with three.js: ground with a layer, sites, the lander to scale, the track.
"use strict";
let space = null;
async function showScene() {
  const parent = byId("scene");
  try {
    if (!window.THREE) await loadLibrary("library-3d");
    space = space || new Space(parent);
  } catch (error) {
    parent.innerHTML = "<p class='warning'>This browser shows no 3D (WebGL): " +
      "the map and the section show the same ground.</p>";
    return;
  }
  space.resize(); space.update();
  if (view.camera) { space.look(view.camera.split(",").map(Number)); view.camera = null; }
  root.dataset.scene = "yes";
}
class Space {
  constructor(parent) {
    const T = THREE;
    this.parent = parent;
    this.renderer = new T.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
    this.renderer.setPixelRatio(window.devicePixelRatio || 1);
    parent.append(this.renderer.domElement);
    this.scene = new T.Scene();
    this.eye = new T.PerspectiveCamera(40, 1, 0.1, 20000);
    this.eye.up.set(0, 0, 1);
    this.middle = { x: (extent.x0 + extent.x1) / 2, y: (extent.y0 + extent.y1) / 2 };
    this.reach = Math.hypot(extent.x1 - extent.x0, extent.y1 - extent.y0) / 2;
    this.controls = new T.OrbitControls(this.eye, this.renderer.domElement);
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    this.controls.addEventListener("change", () => { this.render(); saveView(); });
    const sun = new T.DirectionalLight(0xffffff, 2.6);
    sun.position.set(-1, 1, 1.15);
    this.scene.add(sun, new T.AmbientLight(0xffffff, 0.9));
    this.sun = sun;
    this.makeGround();
    this.marks = new T.Group();
    this.scene.add(this.marks);
    this.fit();
    byId("exaggeration").oninput = () => this.update();
    byId("scene-track").onclick = () => this.fitTrack();
    this.renderer.domElement.addEventListener("pointermove", e => this.point(e));
    this.renderer.domElement.addEventListener("pointerleave", hideTooltip);
  }
  makeGround() { // one vertex per cell; unobserved ground stays open
    const T = THREE, { n, size } = fine;
    const at = (v, low) => clamp(Math.floor((v - low) / size), 0, n - 1);
    const i0 = at(extent.x0, leaves.xmin), i1 = at(extent.x1, leaves.xmin);
    const j0 = at(extent.y0, leaves.ymin), j1 = at(extent.y1, leaves.ymin);
    const wide = i1 - i0 + 1, places = [], index = [];
    this.z0 = limitsOf(fine.z)[0];
    for (let j = j0; j <= j1; j++) for (let i = i0; i <= i1; i++) {
      const z = fine.z[j * n + i];
      places.push(leaves.xmin + (i + 0.5) * size - this.middle.x,
                  leaves.ymin + (j + 0.5) * size - this.middle.y, Number.isNaN(z) ? 0 : z - this.z0);
    }
    const known = (i, j) => !Number.isNaN(fine.z[j * n + i]);
    for (let j = j0; j < j1; j++) for (let i = i0; i < i1; i++) {
      if (!(known(i, j) && known(i + 1, j) && known(i, j + 1) && known(i + 1, j + 1))) continue;
      const a = (j - j0) * wide + i - i0;
      index.push(a, a + 1, a + wide + 1, a, a + wide + 1, a + wide);
    }
    const shape = this.shape = new T.BufferGeometry();
    shape.setAttribute("position", new T.BufferAttribute(new Float32Array(places), 3));
    shape.setAttribute("uv", new T.BufferAttribute(new Float32Array(places.length / 3 * 2), 2));
    shape.setIndex(index);
    shape.computeVertexNormals();
    this.ground = new T.Mesh(shape, new T.MeshLambertMaterial({ side: T.DoubleSide }));
    this.scene.add(this.ground);
  }
  update(going = false) { // layer, exaggeration, sites, time, colours
    if (view.mode !== "scene") return;
    const T = THREE, { canvas, box: [x, y, w, h] } = this.skin();
    const uv = this.shape.attributes.uv, place = this.shape.attributes.position;
    for (let k = 0; k < uv.count; k++) {
      uv.setXY(k, (place.getX(k) + this.middle.x - x) / w, (place.getY(k) + this.middle.y - y) / h);
    }
    uv.needsUpdate = true;
    const material = this.ground.material;
    if (material.map) material.map.dispose();
    material.map = new T.CanvasTexture(canvas);
    material.map.colorSpace = T.SRGBColorSpace;
    material.map.magFilter = T.NearestFilter;
    material.map.anisotropy = this.renderer.capabilities.getMaxAnisotropy();
    material.needsUpdate = true;
    this.sun.intensity = view.relief ? 1.6 : 0;
    this.scene.children.find(c => c.isAmbientLight).intensity = view.relief ? 1.9 : Math.PI;
    this.high = Number(byId("exaggeration").value);
    this.ground.scale.z = this.high;
    this.scene.background = new T.Color(ink("--void"));
    this.marks.traverse(o => { if (o.geometry) o.geometry.dispose(); });
    this.marks.clear();
    if (view.sites) this.drawSites();
    this.drawScale();
    if (view.track || view.answer >= 0) this.drawTrack();
    if (data.flight) flightInSpace(this);
    if (going && sites[view.site]) this.approach(sites[view.site]);
    this.render();
  }
  skin() { // the layer, lit as on the map
    const found = picture(view.layer, view.answer);
    if (!view.relief) return found;
    const canvas = document.createElement("canvas"), size = canvas.width = canvas.height =
      Math.min(4 * fine.n, 2048);
    const c = canvas.getContext("2d"), [x, y, w, h] = found.box, scale = size / leaves.size;
    const put = (from, [a, b, u, v]) => c.drawImage(from, (a - leaves.xmin) * scale,
      size - (b + v - leaves.ymin) * scale, u * scale, v * scale);
    c.imageSmoothingEnabled = false;
    put(found.canvas, [x, y, w, h]);
    [c.globalCompositeOperation, c.globalAlpha] = reliefOf(LAYERS[view.layer]);
    c.imageSmoothingEnabled = true;
    const lit = reliefPicture(view.answer);
    put(lit.canvas, lit.box);
    return { canvas, box: lit.box };
  }
  at(x, y, z) { // map to scene coordinates
    return new THREE.Vector3(x - this.middle.x, y - this.middle.y, this.high * (z - this.z0));
  }
  on(x, y, above = 0.04) {
    const z = heightAt(x, y);
    const found = this.at(x, y, Number.isNaN(z) ? this.z0 : z);
    found.z += above;
    return found;
  }
  line(points, colour, closed = false) {
    const T = THREE, shape = new T.BufferGeometry().setFromPoints(points);
    const found = new (closed ? T.LineLoop : T.Line)(shape, new T.LineBasicMaterial({ color: colour }));
    this.marks.add(found);
    return found;
  }
  circle(x, y, radius, colour) {
    const turn = k => 2 * Math.PI * k / 96;
    this.line(Array.from({ length: 96 }, (_, k) => this.on(
      x + radius * Math.cos(turn(k)), y + radius * Math.sin(turn(k)), 0.08)), colour, true);
  }
  drawSites() {
    const T = THREE;
    const shown = view.answer < 0 ? sites : data.history.sites[view.answer].map(
      ([, x, y], k) => ({ x, y, rank: k + 1 }));
    for (const site of shown) {
      const chosen = view.answer < 0 && site.rank - 1 === view.site;
      const top = this.on(site.x, site.y, chosen ? 3 * data.lander.radius : 2.2 * data.zone);
      for (const r of [1, 0.985, 0.97]) this.circle(site.x, site.y, r * data.zone, 0x111111);
      this.circle(site.x, site.y, 1.02 * data.zone, 0xffffff);
      this.line([this.on(site.x, site.y), top], chosen ? 0x0b5fa5 : 0x1c1c1c);
      this.label(this.badge(site.rank, chosen), top);
      if (chosen && !data.flight) this.drawLander(site); // a flight draws its own
    }
  }
  label(map, place, wide = 1) {
    const T = THREE, found = new T.Sprite(new T.SpriteMaterial({ map, sizeAttenuation: false,
      depthTest: false }));
    found.scale.set(0.034 * wide, 0.034, 1);
    found.position.copy(place);
    this.marks.add(found);
  }
  drawScale() { // scale bar along x and an arrow to the north (y)
    const length = nice((extent.x1 - extent.x0) / 5), tip = length / 6, up = 0.3;
    const x = extent.x0, y = extent.y0, ink = 0xc00000, z = this.z0 + up;
    const at = (u, v) => this.at(x + u, y + v, z);
    this.line([at(0, tip), at(0, 0), at(length, 0), at(length, tip)], ink);
    this.line([at(0, 0), at(0, length), at(-tip / 2, length - tip), at(0, length), at(tip / 2, length - tip)], ink);
    this.label(this.words(`${plain(length, length)} m`), at(length / 2, -tip), 2.5);
    this.label(this.words("north"), at(0, length + tip), 2.5);
  }
  words(text) {
    const canvas = document.createElement("canvas"), c = canvas.getContext("2d");
    canvas.width = 160; canvas.height = 64;
    c.fillStyle = "rgba(255,255,255,.85)"; c.fillRect(0, 8, 160, 48);
    c.fillStyle = "#c00000"; c.font = "bold 34px system-ui, sans-serif";
    c.textAlign = "center"; c.textBaseline = "middle"; c.fillText(text, 80, 33);
    const map = new THREE.CanvasTexture(canvas);
    map.colorSpace = THREE.SRGBColorSpace;
    return map;
  }
  badge(text, chosen) {
    const canvas = document.createElement("canvas"), c = canvas.getContext("2d");
    canvas.width = canvas.height = 64;
    c.beginPath(); c.arc(32, 32, 28, 0, 2 * Math.PI);
    c.fillStyle = chosen ? "#0b5fa5" : data.colours.site; c.fill();
    c.strokeStyle = "#fff"; c.lineWidth = 4; c.stroke();
    c.fillStyle = "#fff"; c.font = "bold 36px system-ui, sans-serif";
    c.textAlign = "center"; c.textBaseline = "middle"; c.fillText(text, 32, 35);
    const map = new THREE.CanvasTexture(canvas);
    map.colorSpace = THREE.SRGBColorSpace;
    return map;
  }
  // Four pads on the ground below, on the circle that they stand on.
  drawLander(site, ground = heightAt) {
    const T = THREE, { radius, pad } = data.lander, up = new T.Vector3(0, 0, 1);
    const metal = new T.MeshLambertMaterial({ color: 0xd8b030 });
    const body = new T.MeshLambertMaterial({ color: 0xe8e8e8 });
    const feet = [0, 1, 2, 3].map(k => {
      const turn = Math.PI * (0.25 + 0.5 * k);
      const x = site.x + radius * Math.cos(turn), y = site.y + radius * Math.sin(turn);
      let z = -Infinity; // a pad stands on the highest ground under it
      for (let a = 0; a < 12; a++) for (const r of [0, 0.5, 1]) {
        const h = ground(x + r * pad * Math.cos(a * Math.PI / 6), y + r * pad * Math.sin(a * Math.PI / 6));
        if (h > z) z = h;
      }
      return this.at(x, y, Number.isFinite(z) ? z : site.z);
    });
    const middle = feet.reduce((sum, f) => sum.add(f), new T.Vector3()).multiplyScalar(0.25);
    middle.addScaledVector(up, 0.65 * radius);
    const beam = (from, to, thick) => {
      const along = to.clone().sub(from);
      const mesh = new T.Mesh(new T.CylinderGeometry(thick, thick, along.length(), 8), metal);
      mesh.position.copy(from).addScaledVector(along, 0.5);
      mesh.quaternion.setFromUnitVectors(new T.Vector3(0, 1, 0), along.normalize());
      this.marks.add(mesh);
    };
    for (const foot of feet) {
      const plate = new T.Mesh(new T.CylinderGeometry(pad, pad, 0.06, 20), metal);
      plate.rotation.x = Math.PI / 2;
      plate.position.copy(foot).addScaledVector(up, 0.03);
      this.marks.add(plate);
      const off = foot.clone().sub(middle), out = off.addScaledVector(up, -off.dot(up)).normalize();
      const hip = middle.clone().addScaledVector(out, 0.42 * radius);
      beam(foot, hip, 0.03 * radius);
      beam(foot, hip.addScaledVector(up, 0.45 * radius), 0.02 * radius);
    }
    const hull = new T.Mesh(new T.CylinderGeometry(0.42 * radius, 0.5 * radius, 0.5 * radius, 8), body);
    hull.rotation.x = Math.PI / 2;
    hull.position.copy(middle).addScaledVector(up, 0.22 * radius);
    this.marks.add(hull);
  }
  drawTrack() { // track, and the scan at the shown time
    const h = data.history;
    if (!h) return;
    const now = view.answer < 0 ? Infinity : h.seconds[view.answer];
    const last = h.scan_seconds.filter(t => t <= now).length;
    const from = k => this.at(h.position[3 * k], h.position[3 * k + 1], h.position[3 * k + 2]);
    if (last < 1) return;
    this.line(Array.from({ length: last }, (_, k) => from(k)), 0x2f7fd0);
    const eye = from(last - 1), edge = [];
    for (let j = 0; j < h.corners; j++) {
      const i = 2 * ((last - 1) * h.corners + j);
      if (!Number.isFinite(h.outline[i])) return;
      edge.push(this.on(h.outline[i], h.outline[i + 1], 0.1));
    }
    this.line(edge, 0x2f7fd0, true);
    for (let j = 0; j < h.corners; j += 3) this.line([eye, edge[j]], 0x6fa8dc);
  }
  fit() {
    const d = 1.75 * this.reach / Math.min(1, this.eye.aspect);
    this.controls.target.set(0, 0, 0);
    this.eye.position.set(-0.35 * d, -0.8 * d, 0.62 * d);
    this.controls.update();
  }
  fitTrack() {
    const h = data.history;
    if (!h || !h.position.length) return;
    view.track = byId("show-track").checked = true;
    this.update();
    const top = this.at(h.position[0], h.position[1], h.position[2]);
    this.controls.target.copy(top).multiplyScalar(0.45);
    const d = 1.5 * Math.max(top.length(), this.reach), side = Math.atan2(top.y, top.x) - Math.PI / 2;
    this.eye.position.copy(this.controls.target);
    this.eye.position.x += d * Math.cos(side); this.eye.position.y += d * Math.sin(side);
    this.eye.position.z += 0.35 * d;
    this.controls.update();
  }
  approach(site) {
    const d = 8 * data.zone; // keeps its label in view
    this.controls.target.copy(this.on(site.x, site.y, 0.4));
    this.eye.position.copy(this.controls.target);
    this.eye.position.x -= 0.35 * d; this.eye.position.y -= 0.8 * d; this.eye.position.z += 0.45 * d;
    this.controls.update();
  }
  zoom(factor) {
    this.eye.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }
  camera() {
    return [this.eye.position, this.controls.target].flatMap(v =>
      [v.x, v.y, v.z].map(c => c.toFixed(2))).join();
  }
  look([x, y, z, u, v, w]) {
    this.eye.position.set(x, y, z); this.controls.target.set(u, v, w);
    this.controls.update();
  }
  point(e) { // tooltip with the values under the pointer
    if (e.buttons || e.pointerType === "touch") { tooltip.hidden = true; return; }
    const box = this.renderer.domElement.getBoundingClientRect(), ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2(2 * (e.clientX - box.left) / box.width - 1,
      1 - 2 * (e.clientY - box.top) / box.height), this.eye);
    const [hit] = ray.intersectObject(this.ground);
    if (!hit) { hideTooltip(); return; }
    placeTooltip(hit.point.x + this.middle.x, hit.point.y + this.middle.y,
               e.clientX - box.left, e.clientY - box.top);
  }
  resize() {
    const w = this.parent.clientWidth, h = this.parent.clientHeight;
    if (!w || !h) return;
    this.eye.aspect = w / h;
    this.eye.updateProjectionMatrix();
    this.renderer.setSize(w, h);
    this.render();
  }
  render() { this.renderer.render(this.scene, this.eye); }
}
