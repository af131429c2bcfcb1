// What the page waits for: what Python prepares, and answers that take long.

const POLL = 300; // milliseconds between questions about progress
const FIRST = 50; // before there is a scene
const LONG_WAIT = 400; // milliseconds from which on an answer is waited for in words

// Asks what Python prepares until it is finished, and calls `heard` with each answer. `size` has the size of pictures.
export function follow(ask, size, heard) {
  let timer = 0;
  let closed = false;
  const poll = async () => {
    let finished = false;
    let pause = POLL;
    try {
      const { content } = await ask({ kind: "progress", ...size() });
      if (closed) return;
      heard(content);
      finished = content.kind !== "progress" || content.finished;
      if (!content.version) pause = FIRST;
    } catch (error) {
      if (!closed) heard({ kind: "error", message: `no answer from Python: ${error.message}` });
    }
    if (!finished && !closed) timer = setTimeout(poll, pause);
  };
  poll();
  return () => {
    closed = true;
    clearTimeout(timer);
  };
}

// The texts of all that is waited for; `show` gets the newest, and the share of it that is done, null if nobody knows.
export class Waiting {
  constructor(show) {
    this.show = show;
    this.texts = new Map();
  }
  set(name, text, share = null) {
    this.texts.delete(name);
    if (text) this.texts.set(name, [text, share]);
    this.show(...([...this.texts.values()].pop() ?? ["", null]));
  }
  // Waits for a promise; the text appears if it takes long.
  async during(name, text, promise, patience = LONG_WAIT) {
    const timer = setTimeout(() => this.set(name, text), patience);
    try {
      return await promise;
    } finally {
      clearTimeout(timer);
      this.set(name, "");
    }
  }
}
