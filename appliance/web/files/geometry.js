// What is drawn on a map: a grid, a pose and points, from messages of strangers. All in metres and
// radians (REP 103). Raises an Error that says what is wrong.

import { stampOf } from './transforms.js'
import { field, numberAt, textAt } from './values.js'

export const MOST_CELLS = 4096 * 4096
export const MOST_POINTS = 100000
const FARTHEST = 1e6 // m; farther away nothing is drawn

/** A nav_msgs/OccupancyGrid: {frame, width, height, resolution, x, y, yaw, cells}. */
export function gridOf(message) {
  const info = field(message, 'info')
  const [width, height, resolution] = ['width', 'height', 'resolution'].map((name) => numberAt(info, name))
  const cells = field(message, 'data')
  const isList = Array.isArray(cells) || cells instanceof Int8Array
  if (!isList) throw new Error('no cells in its field data')
  if (!Number.isInteger(width) || !Number.isInteger(height) || width < 1 || height < 1) {
    throw new Error(`${width} × ${height} is no size of a grid`)
  }
  if (width * height > MOST_CELLS) throw new Error(`${width} × ${height} cells: at most ${MOST_CELLS} are drawn`)
  if (cells.length !== width * height) {
    throw new Error(`${width} × ${height} cells, and ${cells.length} in its field data`)
  }
  if (!(resolution > 0)) throw new Error(`a resolution of ${resolution}: it has to be above 0`)
  if (resolution * Math.max(width, height) > FARTHEST) throw new Error(`cells of ${resolution} m: it is too large`)
  const { x, y, yaw } = pose2d(field(info, 'origin'))
  return { frame: textAt(message, 'header', 'frame_id'), width, height, resolution, x, y, yaw: yaw ?? 0, cells }
}

const UNKNOWN = [0x9a, 0xa4, 0xad]

/** The pixels of a grid, RGBA, a cell each, in its order: the first row is at its origin. */
export function pixelsOf({ cells }) {
  const colours = new Uint32Array(256)
  const shades = new Uint8Array(colours.buffer)
  for (let value = 0; value < 256; value++) {
    const shade = 255 - Math.round(value * 2.3)
    shades.set(value <= 100 ? [shade, shade, shade, 255] : [...UNKNOWN, 255], value * 4)
  }
  const pixels = new Uint32Array(cells.length)
  // -1 is unknown; so is what the message's definition does not have.
  for (let at = 0; at < cells.length; at++) {
    const value = cells[at]
    pixels[at] = colours[value >= 0 && value <= 100 ? value & 0xff : 255]
  }
  return new Uint8ClampedArray(pixels.buffer)
}

/** Where a robot is: {frame, stamp, child, x, y, yaw}; of Odometry and of a pose, with covariance or not. */
export function poseOf(message) {
  const outer = field(message, 'pose')
  const found = pose2d(field(outer, 'pose') ?? outer)
  return { frame: textAt(message, 'header', 'frame_id'), stamp: stampOf(message), child: textAt(message, 'child_frame_id'), ...found }
}

/** The part of a pose in the plane; `yaw` is null where the quaternion is none. */
function pose2d(pose) {
  const x = numberAt(pose, 'position', 'x')
  const y = numberAt(pose, 'position', 'y')
  if (!isNear(x) || !isNear(y)) throw new Error(`a position of (${x}, ${y})`)
  const [qx, qy, qz, qw] = ['x', 'y', 'z', 'w'].map((name) => numberAt(pose, 'orientation', name))
  const length = qx * qx + qy * qy + qz * qz + qw * qw
  const isTurn = length > 1e-6 && length < 1e6
  const yaw = isTurn ? Math.atan2(2 * (qw * qz + qx * qy), length - 2 * (qy * qy + qz * qz)) : null
  return { x, y, yaw }
}

/** The points of a sensor_msgs/LaserScan in its frame: {frame, stamp, points: x and y one after the other}. */
export function scanOf(message) {
  const ranges = field(message, 'ranges')
  if (!Array.isArray(ranges)) throw new Error('no distances in its field ranges')
  const first = numberAt(message, 'angle_min')
  const step = numberAt(message, 'angle_increment')
  if (!Number.isFinite(first) || !Number.isFinite(step)) throw new Error(`angles from ${first} in steps of ${step}`)
  const nearest = numberAt(message, 'range_min') || 0
  const farthest = numberAt(message, 'range_max') || Infinity
  const points = new Points()
  for (let at = 0; at < Math.min(ranges.length, MOST_POINTS); at++) {
    const range = ranges[at] // null where nothing was seen
    if (typeof range !== 'number' || !(range >= nearest && range <= farthest)) continue
    const angle = first + at * step
    points.add(range * Math.cos(angle), range * Math.sin(angle))
  }
  return { frame: textAt(message, 'header', 'frame_id'), stamp: stampOf(message), points: points.list() }
}

const FLOATS = { 7: ['getFloat32', 4], 8: ['getFloat64', 8] } // sensor_msgs/PointField

/** The points of a sensor_msgs/PointCloud2 as `scanOf` has them: evenly some of them, if many. */
export function cloudOf(message) {
  const bytes = bytesIn(field(message, 'data'))
  const step = numberAt(message, 'point_step')
  const row = numberAt(message, 'row_step')
  const [width, height] = [numberAt(message, 'width'), numberAt(message, 'height')]
  const known = [step, row, width, height].every((value) => Number.isInteger(value) && value >= 0)
  if (!known || step < 1 || row < width * step || row * height > bytes.length) {
    throw new Error(`${width} × ${height} points of ${step} bytes in rows of ${row}, and ${bytes.length} bytes`)
  }
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength)
  const isLittle = field(message, 'is_bigendian') !== true
  const [readX, readY] = ['x', 'y'].map((name) => reader(message, name, step, view, isLittle))
  const points = new Points()
  const stride = Math.max(1, Math.ceil((width * height) / MOST_POINTS))
  for (let number = 0; number < width * height; number += stride) {
    const at = Math.floor(number / width) * row + (number % width) * step
    points.add(readX(at), readY(at))
  }
  return { frame: textAt(message, 'header', 'frame_id'), stamp: stampOf(message), points: points.list() }
}

function reader(message, name, step, view, isLittle) {
  const fields = field(message, 'fields')
  const found = Array.isArray(fields) ? fields.slice(0, 100).find((each) => textAt(each, 'name') === name) : undefined
  const [read, size] = FLOATS[numberAt(found, 'datatype')] ?? ['', 0]
  const offset = numberAt(found, 'offset')
  if (!read || !Number.isInteger(offset) || offset < 0 || offset + size > step) {
    throw new Error(`no field ${name} of floats`)
  }
  return (at) => view[read](at + offset, isLittle)
}

function bytesIn(data) {
  if (data instanceof Uint8Array) return data
  if (typeof data !== 'string') throw new Error('no bytes in its field data')
  return Uint8Array.from(atob(data), (char) => char.charCodeAt(0))
}

class Points {
  constructor() {
    this.found = new Float32Array(2048)
    this.length = 0
  }

  /** Add a point, unless it is none, or too far away to be one. */
  add(x, y) {
    if (!isNear(x) || !isNear(y)) return
    if (this.length + 2 > this.found.length) {
      const more = new Float32Array(this.found.length * 2)
      more.set(this.found)
      this.found = more
    }
    this.found[this.length++] = x
    this.found[this.length++] = y
  }

  list() {
    return this.found.slice(0, this.length)
  }
}

function isNear(value) {
  return Math.abs(value) < FARTHEST // which NaN is not
}
