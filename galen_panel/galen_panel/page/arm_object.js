// SPDX-License-Identifier: Apache-2.0
import { STLLoader, THREE } from "nicegui-scene";

// The arm: each part is a group with shapes fixed to it, and only the groups are moved.
export default class ArmObject {
  create_mesh(parts) {
    this.mesh = new THREE.Group();
    this.groups = new Map();
    this.meshes = new Map(); // url -> objects that wait for its triangles
    for (const part of parts) {
      const group = new THREE.Group();
      for (const shape of part.shapes) group.add(drawn(shape, this.meshes));
      this.groups.set(part.name, group);
      this.mesh.add(group);
    }
    this.load();
    return this.mesh;
  }

  // One after the other: the panel answers few requests of an address at a time.
  async load() {
    const loader = new STLLoader();
    for (const [url, objects] of this.meshes) {
      const geometry = await loader.loadAsync(window.path_prefix + url);
      geometry.computeVertexNormals();
      for (const object of objects) object.geometry = geometry;
    }
    this.mesh.userData.loaded = this.meshes.size;
  }

  // Answers true when it has been drawn, so that a slow browser is not sent more than it can show.
  async place(places) {
    for (const [name, place] of Object.entries(places)) {
      const group = this.groups.get(name);
      if (!group) continue;
      group.visible = place !== null;
      if (place === null) continue;
      put(group, place);
      if (place.length > 7) group.scale.set(1, 1, place[7]);
    }
    this.mesh.userData.placed = (this.mesh.userData.placed ?? 0) + 1;
    await galenPanel.drawn();
    return true;
  }
}

function put(object, place) {
  object.position.set(place[0], place[1], place[2]);
  object.quaternion.set(place[3], place[4], place[5], place[6]);
}

function drawn(shape, meshes) {
  const material = new THREE.MeshPhongMaterial({
    color: shape.colour,
    transparent: shape.opacity < 1,
    opacity: shape.opacity,
    depthWrite: shape.opacity === 1,
  });
  const object = new THREE.Group();
  for (const geometry of geometries(shape)) object.add(new THREE.Mesh(geometry, material));
  if (shape.kind === "mesh") {
    const mesh = new THREE.Mesh(new THREE.BufferGeometry(), material);
    meshes.set(shape.url, [...(meshes.get(shape.url) ?? []), mesh]);
    object.add(mesh);
  }
  put(object, shape.place);
  return object;
}

function geometries({ kind, sizes }) {
  if (kind === "mesh") return [];
  if (kind === "sphere") return [new THREE.SphereGeometry(sizes[0], 24, 16)];
  if (kind === "box") return [new THREE.BoxGeometry(...sizes)];
  // three.js has the axes of cylinders along y, URDF along z.
  if (kind === "cylinder") {
    return [new THREE.CylinderGeometry(sizes[0], sizes[0], sizes[1], 28).rotateX(Math.PI / 2)];
  }
  // An arrow of length 1 along z: the part's length stretches it.
  const [shaft, head] = sizes;
  return [
    new THREE.CylinderGeometry(shaft, shaft, 0.75, 16).translate(0, 0.375, 0).rotateX(Math.PI / 2),
    new THREE.ConeGeometry(head, 0.25, 20).translate(0, 0.875, 0).rotateX(Math.PI / 2),
  ];
}
