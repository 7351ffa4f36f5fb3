// Requests to the server. Of each kind one is on its way; while it is, only the newest of those that follow waits.

const page = Array.from(crypto.getRandomValues(new Uint8Array(8)), (b) => b.toString(16).padStart(2, "0")).join("");
const headers = { "Content-Type": "application/json", "X-Page": page };

export class Latest {
  constructor(path, done, failed, who = "") {
    Object.assign(this, { path, done, failed, busy: false, next: null, headers: { ...headers, "X-Page": page + who } });
  }

  ask(state, note) {
    this.next = [JSON.stringify(state), note];
    if (!this.busy) this.run();
  }

  async run() {
    this.busy = true;
    while (this.next !== null) {
      const [body, note] = this.next;
      this.next = null;
      let answer;
      try {
        const reply = await fetch(this.path, { method: "POST", headers: this.headers, body });
        answer = await reply.json();
      } catch {
        answer = { error: "the server does not answer: is the command still running?" };
      }
      if (answer.overtaken) continue;
      try {
        if (answer.error) this.failed(answer.error, note);
        else this.done(answer, note);
      } catch (problem) {
        reportError(problem);
      }
    }
    this.busy = false;
  }
}

export async function once(path, state) {
  const reply = await fetch(path, { method: "POST", headers, body: JSON.stringify(state) });
  const answer = await reply.json();
  if (answer.overtaken) return once(path, state); // a picture went ahead
  if (answer.error) throw new Error(answer.error);
  return answer;
}

// Lines of JSON as they come; a newer request ends the older one.
export class Follow {
  constructor(path, line, failed, who = "") {
    Object.assign(this, { path, line, failed, going: null, headers: { ...headers, "X-Page": page + who } });
  }

  stop() {
    this.going?.abort();
    this.going = null;
  }

  async ask(state) {
    this.stop();
    const mine = (this.going = new AbortController());
    try {
      const reply = await fetch(this.path, { method: "POST", headers: this.headers, body: JSON.stringify(state), signal: mine.signal });
      const reader = reply.body.pipeThrough(new TextDecoderStream()).getReader();
      let rest = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (mine.signal.aborted) return;
        if (done) break;
        const lines = (rest + value).split("\n");
        rest = lines.pop();
        for (const text of lines) this.line(JSON.parse(text));
      }
      if (rest.trim()) this.line(JSON.parse(rest));
    } catch (problem) {
      if (!mine.signal.aborted) this.failed("the budget was cut off: is the command still running?");
    }
  }
}
