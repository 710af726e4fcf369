// JSON as text: numbers keep their own digits, so that 64-bit integers are exact on both ways.

const DEPTH = 32 // levels that are indented
const SHOWN = 64 * 1024 // characters
const LINES = 20000 // and so many words of JSON, with what is between them

/** JSON with a line for each value. What is longer is cut, and says so; what is no JSON stays as it is. */
export function indented(text) {
  const some = text.slice(0, SHOWN)
  const cut = `\n… cut: ${text.length} characters in all`
  const rest = text.length > SHOWN ? cut : ''
  if (!/^\s*[{[]/.test(some)) return some + rest
  const parts = some.match(/"[^"\\]*(?:\\.[^"\\]*)*"?|[{}[\],:]|[^\s"{}[\],:]+/gs) ?? []
  const isOnOneLine = oneLiners(parts)
  let depth = 0
  let flat = false // in an array of plain values
  const line = () => (flat ? '' : `\n${'  '.repeat(Math.min(depth, DEPTH))}`)
  const shown = []
  for (const [index, part] of parts.entries()) {
    if (shown.length > LINES) return shown.join('') + cut
    if (part === '{' || part === '[') {
      depth += 1
      flat = isOnOneLine.has(index)
      shown.push(part, line())
    } else if (part === '}' || part === ']') {
      depth -= 1
      shown.push(line(), part)
      flat = false
    } else if (part === ',') shown.push(flat ? ', ' : part, line())
    else shown.push(part === ':' ? ': ' : part)
  }
  return shown.join('') + rest
}

/** Where arrays of plain values begin, and what is empty. */
function oneLiners(parts) {
  const found = new Set()
  let last = -1
  for (const [index, part] of parts.entries()) {
    if (part === '{' || part === '[') last = index
    else if (part === '}' || part === ']') {
      if (last >= 0 && (part === ']' || last === index - 1)) found.add(last)
      last = -1
    }
  }
  return found
}

/** An object's text of names and of the texts of their values. */
export function objectText(pairs) {
  return `{${pairs.map(([name, text]) => `${JSON.stringify(name)}: ${text}`).join(', ')}}`
}

/** What is wrong with a text that should be JSON, '' if nothing is. */
export function faultOf(text) {
  try {
    JSON.parse(text)
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
