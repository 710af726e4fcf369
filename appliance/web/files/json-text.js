// Texts that should be JSON, and may be none.

import { parse, print } from './exact.js'

const SHOWN = 64 * 1024 // characters

/** JSON with a line for each member, all digits as they came; what is no JSON, or too much, as it is. Cut, and says so. */
export function indented(text) {
  const lines = text.length > SHOWN ? text : printed(text)
  return lines.length > SHOWN ? `${lines.slice(0, SHOWN)}\n… cut: ${text.length} characters in all` : lines
}

function printed(text) {
  try {
    return print(parse(text))
  } catch {
    return text
  }
}

/** What is wrong with a text that should be JSON, '' if nothing is. */
export function faultOf(text) {
  try {
    parse(text)
    return ''
  } catch (error) {
    return `Not JSON: ${error.message}`
  }
}

/** The value of a JSON text, undefined where it is none. For what has no large integers. */
export function valueOf(text) {
  try {
    return JSON.parse(text)
  } catch {
    return undefined
  }
}
