// A map, a pose and a scan, read and drawn into a bitmap away from the page: a large grid takes
// longer than the page may stand still.

import { cloudOf, gridOf, pixelsOf, poseOf, scanOf } from './geometry.js'
import { valueOf } from './values.js'
import { Watch } from './watch-link.js'

const RATES = { grid: 1, pose: 10, scan: 5 } // messages a second

export default class MapView {
  /** `topics` is of grid, pose and scan those that are wanted; `isCloud` for a scan of PointCloud2. */
  constructor(open, { topics, isCloud }) {
    this.readers = { grid: gridOf, pose: poseOf, scan: isCloud ? cloudOf : scanOf }
    this.newest = {}
    const parts = Object.keys(RATES).filter((part) => topics[part])
    const wanted = parts.map((part) => [topics[part], RATES[part]])
    this.watch = new Watch(open, wanted, (topic, payload, properties, at) => {
      for (const part of parts) {
        if (topics[part] === topic) this.newest[part] = { payload, properties, at }
      }
    })
  }

  stop() {
    this.watch.stop()
  }

  /** What is new: parts by their names, each read or with its problem; null when it is over. */
  async next() {
    if (!await this.watch.news()) return null
    const { newest, watch } = this
    this.newest = {}
    const told = { reason: watch.reason, parts: {} }
    for (const [part, { payload, properties, at }] of Object.entries(newest)) {
      try {
        const read = this.readers[part](await valueOf(payload, properties))
        if (part === 'grid') {
          told.bitmap = await createImageBitmap(new ImageData(pixelsOf(read), read.width, read.height))
          delete read.cells
        }
        told.parts[part] = { at, problem: '', ...read }
      } catch (error) {
        told.parts[part] = { at, problem: String(error?.message ?? error).slice(0, 200) }
      }
    }
    return told
  }
}
