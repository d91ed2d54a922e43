  // ---- the page ---------------------------------------------------------------------------
  const raw = await inflate(bytesOf(get("data").textContent));
  const actors = meta.actors.map((info) => prepare(raw, info));
  const last = meta.stamps.length - 1;
  const state = { frame: 0, playing: false, from: 0, seconds: 0, dirty: true };
  ramp();
  home();
  const grid = flat ? null : floor();
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.POLYGON_OFFSET_FILL);
  gl.polygonOffset(1, 1);
  gl.clearColor(1, 1, 1, 1);

  function paint() {
    const scale = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(canvas.clientHeight * scale));
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
    }
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eye = matrices();
    gl.uniformMatrix4fv(U.view, false, eye.view);
    gl.uniformMatrix4fv(U.projection, false, eye.projection);
    gl.uniform3fv(U.up, eye.up);
    if (grid) drawFloor(grid);
    for (const actor of actors) draw(actor, state.frame);
  }
  function show(frame) {
    state.frame = Math.min(Math.max(Math.round(frame), 0), last);
    get("scrub").value = state.frame;
    get("stamp").textContent = meta.stamps[state.frame];
    state.dirty = true;
  }
  function frameAt(seconds) {
    let low = 0, high = last;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (meta.seconds[middle] <= seconds) low = middle; else high = middle - 1;
    }
    return low;
  }
  function play(on) {
    state.playing = on && last > 0;
    if (state.playing && state.frame === last) show(0);
    state.from = performance.now();
    state.seconds = meta.seconds[state.frame];
    get("play").textContent = state.playing ? "\u275A\u275A" : "\u25B6";
  }
  function tick(now) {
    if (state.playing) {
      const begin = meta.seconds[0], length = meta.seconds[last] - begin;
      let seconds = state.seconds + (Number(get("speed").value) * (now - state.from)) / 1000;
      if (seconds > begin + length) {
        seconds = begin + ((seconds - begin) % (length || 1));
        state.seconds = seconds;
        state.from = now;
      }
      const frame = frameAt(seconds);
      if (frame !== state.frame) show(frame);
    }
    if (state.dirty) {
      state.dirty = false;
      paint();
    }
    requestAnimationFrame(tick);
  }

  for (const speed of [0.01, 0.03, 0.1, 0.25, 0.5, 1, 2, 5, 10, 30, 100]) {
    const choice = new Option(`\u00d7 ${speed}`, speed, speed === meta.speed, speed === meta.speed);
    get("speed").add(choice);
  }
  get("scrub").max = last;
  get("scrub").addEventListener("input", (e) => { play(false); show(Number(e.target.value)); });
  get("speed").addEventListener("change", () => play(state.playing));
  get("play").addEventListener("click", () => play(!state.playing));
  get("wire").addEventListener("change", () => { state.dirty = true; });
  const back = () => { home(); state.dirty = true; };
  get("home").addEventListener("click", back);
  canvas.addEventListener("dblclick", back);
  canvas.addEventListener("keydown", (e) => {
    if (e.key === " ") play(!state.playing);
    else if (e.key === "ArrowRight") show(state.frame + 1);
    else if (e.key === "ArrowLeft") show(state.frame - 1);
    else return;
    e.preventDefault();
  });
  const held = new Map();
  const apart = () => {
    const [a, b] = [...held.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  function pan(dx, dy) {
    const R = turning();
    const size = (2 * camera.distance * Math.tan(FIELD / 2)) / canvas.clientHeight;
    for (let k = 0; k < 3; k++) camera.target[k] += size * (dy * R[1][k] - dx * R[0][k]);
  }
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    held.set(e.pointerId, { x: e.clientX, y: e.clientY });
  });
  canvas.addEventListener("pointermove", (e) => {
    const before = held.get(e.pointerId);
    if (!before) return;
    const dx = e.clientX - before.x, dy = e.clientY - before.y;
    const gap = held.size === 2 ? apart() : 0;
    held.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (gap) {
      camera.distance *= gap / Math.max(apart(), 1);
      pan(dx / 2, dy / 2);
    } else if (e.buttons & 6 || e.shiftKey || flat) {
      pan(dx, dy);
    } else {
      camera.yaw -= 0.008 * dx;
      camera.pitch = Math.min(Math.max(camera.pitch + 0.008 * dy, -1.57), 1.57);
    }
    state.dirty = true;
  });
  for (const end of ["pointerup", "pointercancel"])
    canvas.addEventListener(end, (e) => held.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    camera.distance *= Math.exp(0.001 * e.deltaY);
    camera.distance = Math.min(Math.max(camera.distance, 0.02 * radius), 60 * radius);
    state.dirty = true;
  }, { passive: false });
  new ResizeObserver(() => { state.dirty = true; }).observe(canvas);

  if (last === 0) document.body.classList.add("still");
  if (meta.live) {
    // A live page: one frame, filled again by what the server sends.
    new EventSource(meta.live).onmessage = (event) => {
      const news = JSON.parse(event.data);
      const words = new Int16Array(bytesOf(news.points).buffer);
      let start = 0;
      for (const actor of actors) {
        actor.frames[0] = words.subarray(start, (start += 3 * actor.points));
        actor.drawn = -1;
      }
      meta.stamps[0] = news.stamp;
      show(0);
    };
  }
  const wanted = new URLSearchParams(location.hash.slice(1)).get("frame");
  show(wanted === null ? 0 : Number(wanted));
  requestAnimationFrame(tick);
  window.viewer = { show, play, state, camera, frames: last + 1, ready: true };
  if (meta.autoplay && wanted === null) play(true);
})();
