/** The 3D picture. It is drawn when something changed, never otherwise. */

import {
  AxesHelper,
  Box3,
  BoxGeometry,
  BufferAttribute,
  BufferGeometry,
  CanvasTexture,
  Color,
  DoubleSide,
  EdgesGeometry,
  Group,
  HemisphereLight,
  InstancedMesh,
  LineBasicMaterial,
  LineDashedMaterial,
  LineSegments,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  MeshLambertMaterial,
  type Object3D,
  PerspectiveCamera,
  Raycaster,
  Scene,
  SphereGeometry,
  Sprite,
  SpriteMaterial,
  SRGBColorSpace,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { ConvexGeometry } from "three/examples/jsm/geometries/ConvexGeometry.js";
import type { ToolPose } from "../../live/messages";
import { centreOf, cholesky, cornersOf, distanceToSee, type SensorModel, type SensorPose, sensorPose, type Vector } from "./geometry";

export type View = "free" | "top" | "front" | "side";
export type Picked = { kind: "marker" | "tool"; id: string };

export interface Marker {
  readonly id: string;
  readonly position: readonly number[];
  readonly covariance: readonly (readonly number[])[] | null;
  readonly kind: "point" | "confirmed" | "tentative" | "coasting" | "suspect" | "second";
  /** Earlier positions, oldest first. */
  readonly tail: readonly (readonly number[])[];
}

export interface DrawnTool {
  readonly id: string;
  readonly pose: ToolPose;
  /** The last usable pose of a tool that is lost now. */
  readonly ghost: boolean;
  readonly label: string;
}

/** What is known of a tool besides its pose. */
export interface ToolShape {
  readonly markers_mm: readonly (readonly number[])[];
  /** Whether its axes carry their names. */
  readonly named: boolean;
}

interface ToolBody {
  readonly group: Group;
  /** What it was made from. */
  readonly made: string;
  /** From the tool's origin to its tip; null: it has none. */
  readonly tipLine: LineSegments | null;
}

const COLOURS = { point: 0x3aa0ff, confirmed: 0x35c46b, tentative: 0xd0d0d0, coasting: 0xf0a030, suspect: 0xff6050, second: 0xd65fc8 };
const TOOL_COLOUR = 0xffd24a;
const GHOST_COLOUR = 0x888888;
const AXES = ["X", "Y", "Z"] as const;
const ROOM = 16;
const MIN_RADIUS_MM = 1.2;

export class SceneView {
  /** Pictures drawn since the start. */
  drawn = 0;
  private readonly renderer: WebGLRenderer;
  private readonly scene = new Scene();
  private readonly camera = new PerspectiveCamera(45, 1, 1, 1e5);
  private readonly controls: OrbitControls;
  private readonly fixed = new Group();
  private readonly planes = new Group();
  private readonly tools = new Map<string, ToolBody>();
  private readonly tails = new LineSegments(
    new BufferGeometry(),
    new LineBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.7 }),
  );
  private spheres: InstancedMesh;
  private markers: readonly Marker[] = [];
  private sensors: readonly { model: SensorModel; pose: SensorPose }[] = [];
  private target = new Vector3();
  private extent = 500;
  /** What the picture shows from all sides [mm]. */
  private frame: readonly Vector[] = [];
  private volume: readonly [Vector, Vector] | null = null;
  private scheduled = false;
  private framed = false;
  private view: View = "free";
  private readonly observer: ResizeObserver;

  constructor(
    private readonly canvas: HTMLCanvasElement,
    private readonly pick: (picked: Picked | null) => void,
    still: boolean,
  ) {
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "low-power" });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = false;
    this.controls.listenToKeyEvents(canvas);
    if (still) this.controls.autoRotate = false;
    this.controls.addEventListener("change", () => this.request());
    this.spheres = this.newSpheres(ROOM);
    this.scene.add(new HemisphereLight(0xffffff, 0x556070, 3), this.fixed, this.planes, this.tails);
    this.tails.frustumCulled = false;
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(canvas);
    canvas.addEventListener("click", this.clicked);
    this.theme();
    this.resize();
  }

  dispose(): void {
    this.observer.disconnect();
    this.canvas.removeEventListener("click", this.clicked);
    this.controls.dispose();
    this.scene.traverse(release);
    this.renderer.dispose();
  }

  /** Take the colours of the page. */
  theme(): void {
    const style = getComputedStyle(this.canvas);
    this.scene.background = new Color(style.getPropertyValue("--scene").trim() || "#101820");
    this.scene.traverse((object) => {
      if (object instanceof Sprite) paintLabel(object);
    });
    this.request();
  }

  /** Take the calibration's sensors, its control points and the volume that it is good for [mm]: what does not move. */
  setCalibration(models: readonly SensorModel[], control: readonly Vector[], volume: readonly [Vector, Vector] | null): void {
    this.volume = volume;
    for (const child of [...this.fixed.children]) {
      child.traverse(release);
      this.fixed.remove(child);
    }
    const centre = centreOf(control);
    this.sensors = models.map((model) => ({ model, pose: sensorPose(model, centre) }));
    const places = this.sensors.map(({ pose }) => pose.position);
    this.frameAll([...control, ...places]);
    this.framed = control.length > 0;
    this.fixed.add(new AxesHelper(this.extent / 8), ...axisNames(this.extent / 8));
    for (const { model, pose } of this.sensors) this.fixed.add(this.sensorBody(model, pose));
    if (volume) this.fixed.add(boxOf(volume));
    if (control.length >= 4) {
      const hull = hullOf(control);
      if (hull) this.fixed.add(hull);
    }
    this.look(this.view);
  }

  setMarkers(markers: readonly Marker[], factor: number, selected: string | null): void {
    this.markers = markers;
    if (!this.framed && markers.length && this.sensors.length) {
      // Without control points, the first markers say where the volume is.
      this.framed = true;
      const found = markers.map(({ position }) => position as Vector);
      this.frameAll([...found, ...this.sensors.map(({ pose }) => pose.position)]);
      this.look(this.view);
    }
    if (markers.length > this.spheres.instanceMatrix.count) {
      let room = this.spheres.instanceMatrix.count;
      while (room < markers.length) room *= 2;
      this.scene.remove(this.spheres);
      release(this.spheres);
      this.spheres = this.newSpheres(room);
    }
    const matrix = new Matrix4();
    const colour = new Color();
    const small = this.smallRadius();
    markers.forEach((marker, index) => {
      const [x = 0, y = 0, z = 0] = marker.position;
      const factorised = marker.covariance ? cholesky(marker.covariance) : null;
      if (factorised && factor > 0) {
        const [a, b, c] = factorised;
        const s = factor;
        matrix.set(a[0] * s, 0, 0, x, b[0] * s, b[1] * s, 0, y, c[0] * s, c[1] * s, c[2] * s, z, 0, 0, 0, 1);
        // An ellipsoid that is too small to be seen is a small sphere.
        if (Math.max(a[0], b[1], c[2]) * s < small) matrix.makeScale(small, small, small).setPosition(x, y, z);
      } else matrix.makeScale(small, small, small).setPosition(x, y, z);
      this.spheres.setMatrixAt(index, matrix);
      this.spheres.setColorAt(index, colour.set(marker.id === selected ? 0xffffff : COLOURS[marker.kind]));
    });
    this.spheres.count = markers.length;
    this.spheres.instanceMatrix.needsUpdate = true;
    if (this.spheres.instanceColor) this.spheres.instanceColor.needsUpdate = true;
    this.spheres.computeBoundingSphere();
    this.setTails();
    this.request();
  }

  setTools(tools: readonly DrawnTool[], shapes: ReadonlyMap<string, ToolShape>): void {
    const kept = new Set(tools.map((tool) => tool.id));
    for (const [id, { group }] of this.tools)
      if (!kept.has(id)) {
        this.scene.remove(group);
        group.traverse(release);
        this.tools.delete(id);
      }
    const matrix = new Matrix4();
    for (const tool of tools) {
      const { rotation: r, translation_mm: t } = tool.pose;
      if (!r || !t) continue;
      const m = (i: number, j: number) => r[i]?.[j] ?? 0;
      matrix.set(
        m(0, 0), m(0, 1), m(0, 2), t[0] ?? 0,
        m(1, 0), m(1, 1), m(1, 2), t[1] ?? 0,
        m(2, 0), m(2, 1), m(2, 2), t[2] ?? 0,
        0, 0, 0, 1,
      );
      const { group, tipLine } = this.toolBody(tool, shapes.get(tool.id));
      group.matrix.copy(matrix);
      group.matrixWorldNeedsUpdate = true;
      const [x = 0, y = 0, z = 0] = tool.pose.tip_mm ?? [];
      // With each pose: where the tip is on the tool changes when it is pivoted.
      if (tipLine) {
        tipLine.geometry.setFromPoints([new Vector3(), new Vector3(x, y, z).applyMatrix4(matrix.invert())]);
        tipLine.geometry.computeBoundingSphere();
      }
    }
    this.request();
  }

  /** Draw the planes in which the sensors see a point [mm]; null: none. */
  setPlanes(point: readonly number[] | null): void {
    for (const child of [...this.planes.children]) {
      this.planes.remove(child);
      release(child);
    }
    if (point) {
      const end = new Vector3(point[0], point[1], point[2]);
      for (const { pose } of this.sensors) {
        const start = new Vector3(...pose.position);
        const slit = new Vector3(...pose.axes[1]).multiplyScalar(this.extent / 6);
        const ray = end.clone().sub(start);
        ray.addScaledVector(new Vector3(...pose.axes[1]), -ray.dot(new Vector3(...pose.axes[1])));
        const far = start.clone().add(ray);
        const corners = [start.clone().sub(slit), start.clone().add(slit), far.clone().add(slit), far.clone().sub(slit)];
        const geometry = new BufferGeometry().setFromPoints(corners);
        geometry.setIndex([0, 1, 2, 0, 2, 3]);
        const material = new MeshBasicMaterial({
          color: 0x6fb7ff, side: DoubleSide, transparent: true, opacity: 0.15, depthWrite: false,
        });
        this.planes.add(new Mesh(geometry, material));
      }
    }
    this.request();
  }

  /** Look from a side, and from the same when the calibration changes. */
  look(view: View): void {
    this.view = view;
    const from: Record<View, readonly [number, number, number]> = {
      free: [0.5, 0.45, -0.6], top: [0, 1, 0.0001], front: [0, 0, -1], side: [1, 0, 0],
    };
    const back = new Vector3(...from[view]).normalize();
    this.controls.target.copy(this.target);
    this.camera.position.copy(this.target).add(back);
    this.camera.lookAt(this.target);
    this.camera.updateMatrixWorld();
    const [right, up] = [new Vector3(), new Vector3()];
    this.camera.matrixWorld.extractBasis(right, up, new Vector3());
    const slope = Math.tan((this.camera.fov * Math.PI) / 360);
    const away = distanceToSee(
      this.frame.map((place) => new Vector3(...place).sub(this.target).toArray()),
      [right.toArray(), up.toArray(), back.toArray()],
      [slope * this.camera.aspect, slope],
    );
    // Sensors' bodies and their names stick out.
    const far = 1.1 * away + this.extent / 9;
    this.camera.position.copy(this.target).addScaledVector(back, far);
    this.camera.near = far / 1000;
    this.camera.far = far * 20;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.request();
  }

  /** Take the centre and the extent of the picture from points [mm]. */
  private frameAll(given: readonly Vector[]): void {
    const points = [...given, ...(this.volume ? cornersOf(this.volume) : [])];
    this.frame = points;
    new Box3().setFromPoints(points.map((place) => new Vector3(...place))).getCenter(this.target);
    this.extent = 1.1 * Math.max(100, ...points.map((place) => this.target.distanceTo(new Vector3(...place))));
  }

  private smallRadius(): number {
    return Math.max(MIN_RADIUS_MM, this.extent / 80);
  }

  private request(): void {
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame(() => {
      this.scheduled = false;
      this.drawn += 1;
      this.renderer.render(this.scene, this.camera);
    });
  }

  private resize(): void {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.request();
  }

  private newSpheres(room: number): InstancedMesh {
    const spheres = new InstancedMesh(new SphereGeometry(1, 12, 8), new MeshLambertMaterial(), room);
    spheres.count = 0;
    spheres.frustumCulled = false;
    this.scene.add(spheres);
    return spheres;
  }

  private setTails(): void {
    const count = this.markers.reduce((sum, marker) => sum + Math.max(0, marker.tail.length - 1), 0);
    const places = new Float32Array(count * 6);
    const colours = new Float32Array(count * 6);
    const colour = new Color();
    let next = 0;
    for (const { tail, kind } of this.markers) {
      colour.set(COLOURS[kind]);
      for (let index = 1; index < tail.length; index++)
        for (const place of [tail[index - 1], tail[index]]) {
          places.set(place?.slice(0, 3) ?? [], next);
          colours.set([colour.r, colour.g, colour.b], next);
          next += 3;
        }
    }
    this.tails.geometry.dispose();
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(places, 3));
    geometry.setAttribute("color", new BufferAttribute(colours, 3));
    this.tails.geometry = geometry;
  }

  private sensorBody(model: SensorModel, pose: SensorPose): Group {
    const size = this.extent / 9;
    const group = new Group();
    const body = new Mesh(
      new BoxGeometry(size, size / 3, size / 3),
      new MeshLambertMaterial({ color: 0x8395a7 }),
    );
    group.add(body, sprite(model.name, size));
    const [x, y, z] = pose.axes.map((axis) => new Vector3(...axis)) as [Vector3, Vector3, Vector3];
    group.matrixAutoUpdate = false;
    group.matrix.makeBasis(x, y, z).setPosition(...pose.position);
    return group;
  }

  private toolBody(tool: DrawnTool, shape: ToolShape | undefined): ToolBody {
    const existing = this.tools.get(tool.id);
    const tipped = Boolean(tool.pose.tip_mm);
    const made = JSON.stringify([tool.ghost, tool.label, tipped, shape, this.extent]);
    if (existing?.made === made) return existing;
    if (existing) {
      this.scene.remove(existing.group);
      existing.group.traverse(release);
    }
    const size = this.extent / 8;
    const group = new Group();
    group.name = tool.id;
    group.matrixAutoUpdate = false;
    const axes = new AxesHelper(size);
    if (tool.ghost) {
      axes.setColors(GHOST_COLOUR, GHOST_COLOUR, GHOST_COLOUR);
      (axes.material as LineBasicMaterial).transparent = true;
      (axes.material as LineBasicMaterial).opacity = 0.5;
    }
    const colour = tool.ghost ? GHOST_COLOUR : TOOL_COLOUR;
    group.add(axes, sprite(tool.label, size));
    if (shape) group.add(toolMarkers(shape.markers_mm, 0.7 * this.smallRadius(), colour));
    if (shape?.named) group.add(...axisNames(size));
    const tipLine = tipped ? new LineSegments(new BufferGeometry(), new LineBasicMaterial({ color: colour })) : null;
    if (tipLine) group.add(tipLine);
    this.scene.add(group);
    const body = { group, made, tipLine };
    this.tools.set(tool.id, body);
    return body;
  }

  private readonly clicked = (event: MouseEvent): void => {
    const box = this.canvas.getBoundingClientRect();
    const place = new Vector2(
      ((event.clientX - box.left) / box.width) * 2 - 1,
      1 - ((event.clientY - box.top) / box.height) * 2,
    );
    const caster = new Raycaster();
    caster.params.Line.threshold = this.extent / 100;
    caster.setFromCamera(place, this.camera);
    const [marker] = caster.intersectObject(this.spheres);
    const found = marker?.instanceId === undefined ? undefined : this.markers[marker.instanceId];
    if (found) {
      this.pick({ kind: "marker", id: found.id });
      return;
    }
    const [tool] = caster.intersectObjects([...this.tools.values()].map(({ group }) => group));
    let owner: Object3D | null = tool?.object ?? null;
    while (owner && !this.tools.has(owner.name)) owner = owner.parent;
    this.pick(owner ? { kind: "tool", id: owner.name } : null);
  };
}

/** Return the markers [mm] of a tool's body, as spheres. */
function toolMarkers(places: readonly (readonly number[])[], radius: number, color: number): InstancedMesh {
  const spheres = new InstancedMesh(new SphereGeometry(radius, 10, 6), new MeshLambertMaterial({ color }), places.length);
  const matrix = new Matrix4();
  places.forEach(([x = 0, y = 0, z = 0], index) => spheres.setMatrixAt(index, matrix.makeTranslation(x, y, z)));
  return spheres;
}

/** Return the names of axes of this length. */
function axisNames(length: number): Sprite[] {
  return AXES.map((name, axis) => {
    const made = sprite(name, 0);
    made.position.setComponent(axis, 1.15 * length);
    return made;
  });
}

/** Return text that faces the camera. */
function sprite(label: string, size: number): Sprite {
  const canvas = document.createElement("canvas");
  canvas.width = 512;
  canvas.height = 64;
  // As large on the screen whatever the distance.
  const map = new CanvasTexture(canvas);
  map.colorSpace = SRGBColorSpace;
  const made = new Sprite(new SpriteMaterial({ map, depthTest: false, sizeAttenuation: false }));
  made.scale.set(0.24, 0.03, 1);
  made.position.y = size * 0.6;
  made.userData["label"] = label;
  paintLabel(made);
  return made;
}

/** Write a sprite's label onto it, in the page's colour of text now. */
function paintLabel({ material, userData }: Sprite): void {
  const { map } = material;
  const label = userData["label"] as string;
  const canvas = map?.image as HTMLCanvasElement | undefined;
  const context = canvas?.getContext("2d");
  if (!map || !canvas || !context) return;
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.font = "44px sans-serif";
  context.textAlign = "center";
  context.fillStyle = getComputedStyle(document.documentElement).color;
  context.fillText(label.length > 40 ? `${label.slice(0, 39)}…` : label, 256, 42);
  map.needsUpdate = true;
}

/** Return the edges of a box, dashed. */
function boxOf([low, high]: readonly [Vector, Vector]): LineSegments {
  const [from, to] = [new Vector3(...low), new Vector3(...high)];
  const size = to.clone().sub(from);
  const box = new BoxGeometry(size.x, size.y, size.z);
  const edges = new EdgesGeometry(box);
  box.dispose();
  const dash = size.length() / 60;
  const lines = new LineSegments(edges, new LineDashedMaterial({ color: 0xc7a77f, dashSize: dash, gapSize: dash }));
  lines.computeLineDistances();
  lines.position.copy(from).addScaledVector(size, 0.5);
  return lines;
}

/** Return the edges of the points' convex hull; null where they span none. */
function hullOf(points: readonly Vector[]): LineSegments | null {
  try {
    const hull = new ConvexGeometry(points.map((place) => new Vector3(...place)));
    const edges = new EdgesGeometry(hull, 5);
    hull.dispose();
    return new LineSegments(edges, new LineBasicMaterial({ color: 0x7fa7c7, transparent: true, opacity: 0.35 }));
  } catch {
    return null;
  }
}

function release(object: Object3D): void {
  const { geometry, material } = object as Partial<Mesh>;
  geometry?.dispose();
  if (object instanceof InstancedMesh) object.dispose();
  for (const one of Array.isArray(material) ? material : material ? [material] : []) {
    (one as SpriteMaterial).map?.dispose();
    one.dispose();
  }
}
