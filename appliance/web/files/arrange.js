// How a grid, a pose and a scan lie together. Their frames are compared by name: no transforms (TF)
// are applied, and what that means for the drawing is said.

export const OLD = 3000 // ms after which a pose or a scan is drawn as an old one

/** The points, turned by `yaw` and then moved. */
export function placed(points, { x, y, yaw }) {
  const [cos, sin] = [Math.cos(yaw ?? 0), Math.sin(yaw ?? 0)]
  const found = new Float32Array(points.length)
  for (let at = 0; at < points.length; at += 2) {
    found[at] = x + cos * points[at] - sin * points[at + 1]
    found[at + 1] = y + sin * points[at] + cos * points[at + 1]
  }
  return found
}

/** What is drawn of the parts: {frame, points or null, notes}. */
export function arranged({ grid, pose, scan }) {
  const frame = nameOf(grid ?? pose ?? scan)
  const notes = []
  if (grid && pose && nameOf(pose) !== frame) {
    notes.push(`The pose is in the frame ${nameOf(pose)}, the map in ${frame}. Transforms (TF) are not applied: `
      + 'the robot is drawn as if both were the same.')
  }
  if (pose && pose.yaw === null) notes.push('The pose has no heading: its quaternion is none.')
  if (!scan || nameOf(scan) === frame) return { frame, points: scan?.points ?? null, notes }
  if (!pose || pose.yaw === null) {
    notes.push(`The scan is in the frame ${nameOf(scan)}, and nothing says where that is in ${frame}: it is not drawn. `
      + 'Transforms (TF) are not applied; a pose with a heading would do.')
    return { frame, points: null, notes }
  }
  if (nameOf(scan) !== withoutSlash(pose.child)) {
    notes.push(`The scan is in the frame ${nameOf(scan)}. Transforms (TF) are not applied: it is drawn as if the sensor `
      + 'were in the robot’s middle and looked ahead.')
  }
  return { frame, points: placed(scan.points, pose), notes }
}

/** The corners of a grid, x and y one after the other. */
export function corners(grid) {
  const [width, height] = [grid.width * grid.resolution, grid.height * grid.resolution]
  return placed([0, 0, width, 0, width, height, 0, height], grid)
}

function nameOf(part) {
  return withoutSlash(part?.frame ?? '') || '(without a name)'
}

/** ROS 1's names may begin with a slash. */
function withoutSlash(name) {
  return name.startsWith('/') ? name.slice(1) : name
}
