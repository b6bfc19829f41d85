// From track features to points on the road, in the car frame (x ahead, y to the left, m, from the
// centre of gravity), and from there to pixels through the model's camera.

export const CG_HEIGHT_M = 0.25; // of the simulated car; the camera's position is relative to it
export const IN_LANE = ["ml", "mr"], ON_MARKING = ["l", "m", "r"];

// A marking `distance` m away (left negative), `ahead` m along the track whose heading is `angle`
// (rad, positive when the car points to the right of it).
export function onMarking(distance, angle, ahead) {
  const cos = Math.cos(angle), sin = Math.sin(angle), left = -distance;
  return [ahead * cos - left * sin, ahead * sin + left * cos];
}

// Pixel [u, v] of a point on the road, null behind the camera. `camera` is that of /model.
export function project([x, y], camera) {
  const focal = camera.height / 2 / Math.tan(camera.fov_y_deg * Math.PI / 360);
  const pitch = camera.pitch_deg * Math.PI / 180; // positive: the camera looks down
  const ahead = x - camera.x, left = y - camera.y, up = -CG_HEIGHT_M - camera.z;
  const depth = ahead * Math.cos(pitch) - up * Math.sin(pitch);
  const above = ahead * Math.sin(pitch) + up * Math.cos(pitch);
  if (depth < 0.3) return null;
  return [camera.width / 2 - focal * left / depth, camera.height / 2 - focal * above / depth];
}

// The part of an image of `width` x `height` that the service uses: the middle, as high as the image
// and with the model's aspect ratio (the service refuses a narrower image).
export function seenPart(width, height, camera) {
  const seen = Math.min(width, height * camera.width / camera.height);
  return { x: (width - seen) / 2, w: seen };
}
