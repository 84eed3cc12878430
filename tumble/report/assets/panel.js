// The relight panel: the object turns, the light stands still. World axes: those of the camera, x right, y up, z to it.
"use strict";
(() => {
  const at = (id) => document.getElementById(id);
  const about = JSON.parse(at("about").textContent);
  const [canvas, note, panel] = [at("view"), at("note"), at("panel")];
  const say = (words) => { note.textContent = words; };
  const bytes = (id) => Uint8Array.from(atob(at(id).textContent.trim()), (c) => c.charCodeAt(0)).buffer;

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
  } catch (error) {
    say("The live view needs WebGL, which this browser does not provide. The rest of the report works without it.");
    document.documentElement.dataset.panel = "no-webgl";
    return;
  }
  renderer.toneMapping = THREE.NeutralToneMapping;
  const scene = new THREE.Scene();
  // A map of a few thousand texels, seen through a window of thirty degrees, is a few blocks.
  scene.backgroundBlurriness = 0.2;
  const camera = new THREE.PerspectiveCamera(about.fov, 1, 0.01, 100);
  const filter = new THREE.PMREMGenerator(renderer);
  const start = new THREE.Quaternion(...about.object_to_camera);
  const turned = new THREE.Group();
  scene.add(turned);

  // One draw per frame of the screen at most, and none while nothing changes.
  let asked = false;
  const draw = () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => { asked = false; renderer.render(scene, camera); });
  };

  // Lights ------------------------------------------------------------------------------------------------------------

  // Mean radiance over the sphere: every light is shown as strong, in all, as the recovered one.
  const strength = (pixels, width, height) => {
    let [sum, area] = [0, 0];
    for (let row = 0; row < height; row++) {
      const ring = Math.sin((row + 0.5) / height * Math.PI);
      area += ring * width;
      for (let i = row * width * 4; i < (row + 1) * width * 4; i += 4)
        sum += ring * (0.2126 * half(pixels[i]) + 0.7152 * half(pixels[i + 1]) + 0.0722 * half(pixels[i + 2]));
    }
    return sum / area;
  };
  const half = (code) => {
    const [exponent, fraction] = [(code >> 10) & 31, code & 1023];
    return exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * fraction / 1024;
  };

  let reference = 0;
  const light = (buffer, name) => {
    const { data, width, height } = new THREE.HDRLoader().parse(buffer);
    if (!width || width !== 2 * height) throw new Error(`a panorama must be twice as wide as high, this image is ${width} x ${height}`);
    const texture = new THREE.DataTexture(data, width, height);
    Object.assign(texture, { type: THREE.HalfFloatType, mapping: THREE.EquirectangularReflectionMapping,
      colorSpace: THREE.LinearSRGBColorSpace, minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter,
      flipY: true, generateMipmaps: false, needsUpdate: true });
    const mean = strength(data, width, height);
    if (!(mean > 0)) throw new Error("this panorama is black");
    reference ||= mean;
    scene.environment?.dispose();
    scene.environment = filter.fromEquirectangular(texture).texture;
    scene.userData.backdrop?.dispose();
    scene.userData.backdrop = texture;
    scene.environmentIntensity = scene.backgroundIntensity = reference / mean;
    document.documentElement.dataset.light = name;
    settle();
  };
  const settle = () => {
    // The map's centre is -z here and +x in three.js: a quarter turn.
    const angle = Math.PI / 2 + at("turn").value * Math.PI / 180;
    scene.environmentRotation.set(0, angle, 0);
    scene.backgroundRotation.set(0, angle, 0);
    scene.background = at("backdrop").checked ? scene.userData.backdrop : null;
    renderer.toneMappingExposure = 2 ** at("exposure").value;
    draw();
  };
  const choose = (button) => {
    for (const other of document.querySelectorAll(".lights button")) other.setAttribute("aria-pressed", other === button);
    if (button) light(bytes(button.dataset.light), button.dataset.light);
  };
  const take = async (file) => {
    if (!file) return;
    try {
      if (!/\.hdr$/i.test(file.name)) throw new Error("only Radiance .hdr files can be used here");
      light(await file.arrayBuffer(), file.name);
      choose(null);
      at("dropped").textContent = file.name;
      say("");
    } catch (error) {
      say(`${file.name}: ${error.message ?? error}`);
    }
  };

  // What a surface sends back is diffuse part plus highlight here, as when it was measured: glTF takes from the diffuse
  // part what the highlight sends back, which makes dielectrics a twentieth darker.
  const additive = (shader) => {
    shader.fragmentShader = shader.fragmentShader.replace("#include <lights_physical_pars_fragment>", `$&
      void additive( const in vec3 radiance, const in vec3 irradiance, const in vec3 coat, const in vec3 place,
          const in vec3 normal, const in vec3 eye, const in vec3 coatNormal, const in PhysicalMaterial material,
          inout ReflectedLight light ) {
        vec3 before = light.indirectDiffuse;
        RE_IndirectSpecular_Physical( radiance, irradiance, coat, place, normal, eye, coatNormal, material, light );
        light.indirectDiffuse = before + material.diffuseContribution * irradiance * RECIPROCAL_PI;
      }
      #undef RE_IndirectSpecular
      #define RE_IndirectSpecular additive`);
  };

  // Hands --------------------------------------------------------------------------------------------------------------

  let [distance, nearest] = [4, 1];
  const turn = (right, down) => {
    const by = new THREE.Quaternion().setFromEuler(new THREE.Euler(down, right, 0, "YXZ"));
    turned.quaternion.premultiply(by).normalize();
    draw();
  };
  const come = (factor) => {
    distance = Math.min(Math.max(distance * factor, nearest), 8 * nearest);
    camera.position.set(0, 0, distance);
    draw();
  };
  const fingers = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY];
    if (fingers.size === 1) turn((now[0] - before[0]) / 150, (now[1] - before[1]) / 150);
    const other = [...fingers].find(([id]) => id !== event.pointerId);
    if (other) {
      const apart = (a) => Math.hypot(a[0] - other[1][0], a[1] - other[1][1]) || 1;
      come(apart(before) / apart(now));
    }
    fingers.set(event.pointerId, now);
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => { event.preventDefault(); come(1.001 ** event.deltaY); }, { passive: false });
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key]) return;
    event.preventDefault();
    turn(...keys[event.key]);
  });

  for (const button of document.querySelectorAll(".lights button")) button.addEventListener("click", () => choose(button));
  for (const id of ["turn", "exposure", "backdrop"]) at(id).addEventListener("input", settle);
  at("file").addEventListener("change", (event) => {
    take(event.target.files[0]);
    event.target.value = ""; // so that the same file can be chosen again
  });
  // Anywhere in the window: a file dropped beside the panel would otherwise replace the page.
  addEventListener("dragover", (event) => { event.preventDefault(); panel.classList.add("over"); });
  addEventListener("dragleave", () => panel.classList.remove("over"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    panel.classList.remove("over");
    take(event.dataTransfer.files[0]);
  });

  const home = () => {
    turned.quaternion.copy(start);
    at("turn").value = at("exposure").value = 0;
    distance = 1.9 * nearest;
    come(1);
    settle();
  };
  at("reset").addEventListener("click", home);

  const fit = () => {
    const { clientWidth: width, clientHeight: height } = canvas;
    if (!width || !height) return;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    draw();
  };
  new ResizeObserver(fit).observe(canvas);

  // The object ---------------------------------------------------------------------------------------------------------

  new THREE.GLTFLoader().parse(bytes("glb"), "", (file) => {
    const box = new THREE.Box3().setFromObject(file.scene);
    const ball = box.getBoundingSphere(new THREE.Sphere());
    file.scene.position.sub(ball.center);
    file.scene.traverse((node) => { if (node.material) node.material.onBeforeCompile = additive; });
    turned.add(file.scene);
    // Nearest: where the ball just fits between the edges, a little inside.
    nearest = 0.55 * ball.radius / Math.sin(Math.min(camera.fov, 90) * Math.PI / 360);
    camera.near = nearest / 100;
    camera.far = nearest * 20;
    camera.updateProjectionMatrix();
    fit();
    choose(document.querySelector(".lights button"));
    home();
    say("");
    requestAnimationFrame(() => { document.documentElement.dataset.panel = "drawn"; });
  }, (error) => say(`The object cannot be shown: ${error.message ?? error}`));
})();
