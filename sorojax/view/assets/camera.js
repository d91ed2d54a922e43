  // ---- camera -----------------------------------------------------------------------------
  const lower = meta.box[0], upper = meta.box[1];
  const span = lower.map((low, k) => upper[k] - low);
  const radius = Math.max(Math.hypot(...span) / 2, 1e-9);
  const flat = span[2] < 1e-6 * radius;
  const FIELD = (30 * Math.PI) / 180;
  const camera = {};
  function home() {
    camera.yaw = flat ? 0 : -0.9;
    camera.pitch = flat ? Math.PI / 2 : 0.42;
    camera.target = lower.map((low, k) => (low + upper[k]) / 2);
    const aspect = canvas.clientWidth / Math.max(canvas.clientHeight, 1);
    const half = Math.atan(Math.tan(FIELD / 2) * Math.min(aspect, 1));
    camera.distance = (1.02 * radius) / Math.sin(half);
  }
  function turning() {
    // World to eye: about z by -yaw, then the view from above down to the horizon.
    const cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw);
    const cp = Math.cos(camera.pitch - Math.PI / 2), sp = Math.sin(camera.pitch - Math.PI / 2);
    return [[cy, sy, 0], [-cp * sy, cp * cy, -sp], [-sp * sy, sp * cy, cp]];
  }
  function matrices() {
    const R = turning(), t = camera.target, d = camera.distance;
    const shift = R.map((row) => -(row[0] * t[0] + row[1] * t[1] + row[2] * t[2]));
    const view = new Float32Array([
      R[0][0], R[1][0], R[2][0], 0, R[0][1], R[1][1], R[2][1], 0, R[0][2], R[1][2], R[2][2], 0,
      shift[0], shift[1], shift[2] - d, 1]);
    const aspect = canvas.width / canvas.height, f = 1 / Math.tan(FIELD / 2);
    const near = d / 200, far = d + 20 * radius;
    const projection = new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0,
      0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0]);
    return { view, projection, up: [R[0][2], R[1][2], R[2][2]] };
  }

  // ---- floor ------------------------------------------------------------------------------
  function floor() {
    const step = 10 ** Math.floor(Math.log10(radius)), reach = Math.ceil((1.5 * radius) / step);
    const cx = Math.round((lower[0] + upper[0]) / 2 / step) * step;
    const cy = Math.round((lower[1] + upper[1]) / 2 / step) * step;
    const lines = [];
    for (let k = -reach; k <= reach; k++) {
      lines.push([k, -reach], [k, reach], [-reach, k], [reach, k]);
    }
    const buffer = gl.createBuffer(), n = lines.length, q = new Int16Array(3 * n);
    lines.forEach(([x, y], k) => {
      q[k] = Math.round((32767 * x) / reach);
      q[n + k] = Math.round((32767 * y) / reach);
    });
    fill(buffer, q);
    const low = lower[2] - 0.002 * radius;
    return { buffer, n, centre: [cx, cy, low], extent: [reach * step, reach * step, 0], step };
  }
  function drawFloor(grid) {
    attribute("x", grid.buffer, 1, gl.SHORT, 2, 0);
    attribute("y", grid.buffer, 1, gl.SHORT, 2, 2 * grid.n);
    attribute("z", grid.buffer, 1, gl.SHORT, 2, 4 * grid.n);
    gl.disableVertexAttribArray(A.normal);
    gl.disableVertexAttribArray(A.value);
    gl.uniformMatrix4fv(U.model, false, UNIT);
    gl.uniform3fv(U.centre, grid.centre);
    gl.uniform3fv(U.extent, grid.extent);
    gl.uniform3f(U.colour, 0.85, 0.86, 0.88);
    gl.uniform1f(U.mapped, 0);
    gl.uniform1f(U.lit, 0);
    gl.drawArrays(gl.LINES, 0, grid.n);
  }
