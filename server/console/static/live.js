// Live pictures for a page: it calls look(), keep()s a canvas a camera, and reads what is known of each in live[name],
// and of the head in `head`.
import { mark } from "/console/static/live_head.js";

export const liveView = {
  data: () => ({ live: {}, fault: "", head: null }),
  created() {
    this.canvas = {};
  },
  unmounted() {
    this.gone = true;
    this.reader?.cancel();
  },
  methods: {
    keep(name, element) {
      if (element) this.canvas[name] = element;
    },
    async look() {
      while (!this.gone) {
        try {
          const answer = await fetch("/console/live");
          if (!answer.ok) throw new Error(answer.statusText);
          this.reader = answer.body.getReader();
          await this.read(this.reader);
        } catch {
          this.fault = "Waiting for the service ...";
        }
        await new Promise((resolve) => setTimeout(resolve, 1000));
      }
    },
    async read(reader) {
      let kept = new Uint8Array(0);
      for (;;) {
        const { done, value } = await reader.read();
        if (done) return;
        const joined = new Uint8Array(kept.length + value.length);
        joined.set(kept);
        joined.set(value, kept.length);
        kept = joined;
        for (;;) {
          if (kept.length < 8) break;
          const view = new DataView(kept.buffer, kept.byteOffset);
          const header = view.getUint32(0),
            body = view.getUint32(4);
          if (kept.length < 8 + header + body) break;
          const document = JSON.parse(new TextDecoder().decode(kept.subarray(8, 8 + header)));
          await this.show(document, kept.slice(8 + header, 8 + header + body));
          kept = kept.slice(8 + header + body);
        }
      }
    },
    async show(document, body) {
      this.fault = document.fault;
      if (document.head?.number !== this.head?.number || !document.head?.number) this.head = document.head;
      let start = 0;
      const drawn = document.cameras.map(async (camera) => {
        const data = body.subarray(start, start + camera.bytes);
        start += camera.bytes;
        const before = this.live[camera.name]?.frames || 0;
        this.live[camera.name] = { ...camera, at: Date.now(), frames: before + (camera.bytes > 0) };
        const canvas = this.canvas[camera.name];
        if (!canvas || !camera.bytes) return;
        const picture = await createImageBitmap(new Blob([data], { type: "image/jpeg" }));
        if (canvas.width !== picture.width || canvas.height !== picture.height) {
          canvas.width = picture.width;
          canvas.height = picture.height;
        }
        const context = canvas.getContext("2d");
        context.drawImage(picture, 0, 0);
        mark(context, this.head?.cameras?.[camera.name]?.points, picture.width, picture.height);
        picture.close();
      });
      await Promise.all(drawn);
    },
  },
};
