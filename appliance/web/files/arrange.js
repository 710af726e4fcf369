// How a grid, a pose and a scan lie together: by transforms (TF) where they are bridged. Without them
// frames are compared by name, and what that means for the drawing is said.

import { moved, withoutSlash } from './transforms.js'

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

/**
 * What is drawn of the parts: {frame, pose or null, points or null, notes}. `tf` says of pose and scan where they are in
 * that frame, see map-link.js; it is undefined where no transforms are bridged.
 */
export function arranged({ grid, pose: told, scan, tf }) {
  const frame = nameOf(grid ?? told ?? scan)
  const notes = tf?.problem ? [tf.problem] : []
  const why = (part) => (tf ? tf[part]?.problem ?? '' : 'Transforms (TF) are not bridged.')
  let pose = told ?? null
  if (pose && nameOf(pose) !== frame) {
    if (tf?.pose?.place) pose = movedPose(pose, tf.pose.place)
    else {
      notes.push(`The pose is in the frame ${nameOf(pose)}, the map in ${frame}. ${why('pose')} The robot is drawn as if `
        + 'both were the same.')
    }
  }
  if (pose && pose.yaw === null) notes.push('The pose has no heading: its quaternion is none.')
  if (!scan || nameOf(scan) === frame) return { frame, pose, points: scan?.points ?? null, notes }
  if (tf?.scan?.place) return { frame, pose, points: movedPoints(scan.points, tf.scan.place), notes }
  if (!pose || pose.yaw === null) {
    notes.push(`The scan is in the frame ${nameOf(scan)}, and nothing says where that is in ${frame}: it is not drawn. `
      + `${why('scan')} A pose with a heading would do.`)
    return { frame, pose, points: null, notes }
  }
  if (nameOf(scan) !== withoutSlash(pose.child ?? '')) {
    notes.push(`The scan is in the frame ${nameOf(scan)}. ${why('scan')} It is drawn as if the sensor were in the robot’s `
      + 'middle and looked ahead.')
  }
  return { frame, pose, points: placed(scan.points, pose), notes }
}

function movedPose(pose, place) {
  const [x, y] = moved(place, pose.x, pose.y)
  const yaw = pose.yaw === null ? null : pose.yaw + Math.atan2(place.c, place.a)
  return { ...pose, x, y, yaw: yaw === null ? null : Math.atan2(Math.sin(yaw), Math.cos(yaw)) }
}

function movedPoints(points, place) {
  const found = new Float32Array(points.length)
  for (let at = 0; at < points.length; at += 2) found.set(moved(place, points[at], points[at + 1]), at)
  return found
}

/** The corners of a grid, x and y one after the other. */
export function corners(grid) {
  const [width, height] = [grid.width * grid.resolution, grid.height * grid.resolution]
  return placed([0, 0, width, 0, width, height, 0, height], grid)
}

function nameOf(part) {
  return withoutSlash(part?.frame ?? '') || '(without a name)'
}
