// Converts track features to points on the road, in the car frame (m; x ahead, y left, origin at the
// centre of gravity), and these points to pixels of a camera.

export const CG_HEIGHT_M = 0.25; // centre of gravity above the road: origin of the camera's position
export const IN_LANE = ["ml", "mr"], ON_MARKING = ["l", "m", "r"];

// The point on a marking at `distance` m (left negative), `ahead` m along the track. `angle` in rad is
// the track's heading minus the car's: positive if the car points to the right of the track.
export function onMarking(distance, angle, ahead) {
  const cos = Math.cos(angle), sin = Math.sin(angle), left = -distance;
  return [ahead * cos - left * sin, ahead * sin + left * cos];
}

// Position [u, v] of a point on the road in an image, in px from the upper left corner; null if the
// camera does not see it. `camera` is a camera of /model; see trackfeatures/camera.py.
export function project([x, y], camera) {
  const [cr, cp, cy] = ANGLES.map((name) => Math.cos((camera[name] ?? 0) * Math.PI / 180));
  const [sr, sp, sy] = ANGLES.map((name) => Math.sin((camera[name] ?? 0) * Math.PI / 180));
  const away = [x - camera.x, y - camera.y, -CG_HEIGHT_M - camera.z];
  const along = (axis) => axis[0] * away[0] + axis[1] * away[1] + axis[2] * away[2];
  const depth = along([cy * cp, sy * cp, -sp]);
  if (depth < 0.3) return null;
  const right = -along([cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr]) / depth;
  const down = -along([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr]) / depth;
  const seen = distort(right, down, camera);
  if (!seen) return null;
  const focal = camera.height / 2 / Math.tan(camera.fov_y_deg * Math.PI / 360);
  const [fx, fy, u, v] = camera.matrix ?? [focal, focal, (camera.width - 1) / 2, (camera.height - 1) / 2];
  return [u + fx * seen[0] + 0.5, v + fy * seen[1] + 0.5];
}

const ANGLES = ["roll_deg", "pitch_deg", "yaw_deg"];

// The distorted position of a point on the plane z = 1; null where the lens model folds.
function distort(x, y, camera) {
  const k = camera.coefficients ?? [];
  const r = Math.hypot(x, y);
  const radius = (r) => {
    if (camera.distortion === "fisheye") {
      const t = Math.atan(r), s = t * t;
      return t * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))));
    }
    const [k1, k2, , , k3 = 0, k4 = 0, k5 = 0, k6 = 0] = k, s = r * r;
    return r * (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)));
  };
  if (!k.length || r < 1e-9) return [x, y];
  for (let share = 0; share < 1; share += 0.02) {
    if (radius(r * (share + 0.02)) <= radius(r * share)) return null;
  }
  const scale = radius(r) / r;
  const [p1, p2] = camera.distortion === "fisheye" ? [0, 0] : [k[2], k[3]];
  return [
    x * scale + 2 * p1 * x * y + p2 * (r * r + 2 * x * x),
    y * scale + p1 * (r * r + 2 * y * y) + 2 * p2 * x * y,
  ];
}

// The part of an image of `width` x `height` that the service uses: its middle, with the image's
// height and the model's aspect ratio (the service refuses a narrower image).
export function seenPart(width, height, camera) {
  const seen = Math.min(width, height * camera.width / camera.height);
  return { x: (width - seen) / 2, w: seen };
}
