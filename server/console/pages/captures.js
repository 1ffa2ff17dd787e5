// A list of captures at the left, the pictures of the chosen one at the right.
import { clock, send, size } from "/console/static/words.js";

export default {
  props: { state: Object },
  emits: ["act"],
  data: () => ({ chosen: null, outlines: false, drawing: 0, large: null, over: false, uploads: [], busy: "" }),
  computed: {
    captures() { return (this.state.captures || []).filter((c) => !c.removed); },
    removed() { return (this.state.captures || []).filter((c) => c.removed); },
    current() { return this.captures.find((c) => c.id === this.chosen) || this.captures[0] || null; },
  },
  template: `
    <section class="page" aria-label="Captures" @dragover.prevent="over = true" @dragleave="over = false" @drop.prevent="drop">
      <header>
        <h1>Captures</h1><span class="lead">{{ state.loading ? 'Reading' : captures.length + (captures.length === 1 ? ' capture' : ' captures') }}</span>
        <template v-if="current">
          <button class="b" :aria-pressed="outlines" @click="outlines = !outlines">Silhouettes</button>
          <a class="b" :href="'/features/' + current.id">Pick features</a>
          <button class="b main-action" id="reconstruct" :disabled="!!busy" @click="act('reconstruct', current.id)">Reconstruct</button>
          <button class="b" id="remove" :disabled="!!busy" @click="act('remove', current.id)">Remove</button>
        </template>
      </header>
      <div class="columns" style="grid-template-columns: 19rem minmax(0, 1fr)">
        <div class="stack" style="min-height: 0">
          <div :class="['drop', { over }]">Drop an archive here (.zip, .tar, .tar.gz)
            <div style="margin-top: .4rem"><button class="b" @click="$refs.file.click()">Choose a file</button>
            <input ref="file" type="file" hidden multiple accept=".zip,.tar,.gz,.tgz" aria-label="Archive of a capture" @change="take($event.target.files); $event.target.value = ''"></div></div>
          <div v-for="u in uploads" :key="u.id" class="panel pad small stack" style="gap: .3rem" role="status">
            <div class="line"><span class="cut grow">{{ u.name }}</span><span class="num">{{ u.state }}</span><button v-if="u.done" class="b quiet" aria-label="Close" @click="uploads = uploads.filter(o => o.id !== u.id)">&times;</button></div>
            <div v-if="!u.done" class="bar" role="progressbar" :aria-valuenow="Math.round(100 * u.share)" aria-valuemin="0" aria-valuemax="100" :aria-label="'Upload of ' + u.name"><i :style="{ width: 100 * u.share + '%' }"></i></div>
            <template v-if="u.detail"><p class="fault">{{ u.detail }}</p><ul class="faults scroll" style="max-height: 14rem"><li v-for="(f, i) in u.errors" :key="i">{{ f }}</li></ul></template>
          </div>
          <div v-for="c in removed" :key="c.id" class="panel pad small line"><span class="grow">Removed {{ clock(c.created) }}</span><button class="b" @click="act('undo', c.id)">Undo</button></div>
          <div class="panel scroll grow" tabindex="0" role="region" aria-label="List of captures">
            <button v-for="c in captures" :key="c.id" class="row-button" :aria-current="current && c.id === current.id" @click="chosen = c.id">
              <span class="line"><strong class="cut grow">{{ c.label || clock(c.created) }}</strong><span class="tag" :class="tag(c).kind">{{ tag(c).text }}</span></span>
              <span class="small muted">{{ clock(c.created) }} &middot; {{ c.source === 'rig' ? 'rig' : 'upload' }} &middot; {{ c.cameras.length }} cameras &middot; {{ size(c.bytes) }}</span>
              <span v-if="c.session || c.expression || c.features" class="small muted">{{ [c.session, c.expression, c.features && 'features picked'].filter(Boolean).join(' · ') }}</span>
            </button>
          </div>
        </div>
        <div class="panel pad scroll" style="position: relative" tabindex="0" role="region" aria-label="Pictures">
          <div v-if="!state.loading && !current" class="empty" style="height: 100%; align-content: center">
            <h2>No captures yet</h2><p>Take one with the rig, or drop an archive of images, clean plates and cameras.json anywhere on this page.</p>
            <a class="b main-action" href="/">Go to the rig</a></div>
          <div v-else-if="current && large === null" class="thumbs">
            <button v-for="(camera, i) in current.cameras" :key="current.id + camera" class="thumb" style="padding: 0; border: 0; cursor: zoom-in" :style="{ aspectRatio: current.size.width + ' / ' + current.size.height }" :aria-label="'Enlarge ' + camera" @click="large = i">
              <img :src="address(camera, '.jpg')" :alt="'Picture of ' + camera" loading="lazy">
              <img v-if="outlines" :src="address(camera, '.silhouette.png')" alt="" @error="failed">
              <span>{{ camera }}{{ camera === current.front ? ' · front' : '' }}</span></button>
          </div>
          <div v-else-if="current" style="height: 100%; display: grid; grid-template-rows: auto minmax(0, 1fr); gap: .6rem">
            <div class="line"><strong>{{ current.cameras[large] }}</strong><span class="push group"><button class="b" @click="step(-1)" aria-label="Previous camera">&larr;</button><button class="b" @click="step(1)" aria-label="Next camera">&rarr;</button></span><button class="b" @click="large = null">All cameras <kbd>Esc</kbd></button></div>
            <div class="thumb" style="aspect-ratio: auto"><img :src="address(current.cameras[large], '.image')" :alt="'Picture of ' + current.cameras[large]"><img v-if="outlines" :src="address(current.cameras[large], '.silhouette.png')" alt=""></div>
          </div>
        </div>
      </div>
    </section>`,
  created() { this.clock = clock; this.size = size; },
  mounted() { window.addEventListener("keydown", this.key); },
  unmounted() { window.removeEventListener("keydown", this.key); },
  methods: {
    address(camera, kind) { return `/console/captures/${this.current.id}/${encodeURIComponent(camera)}${kind}`; },
    act(name, id) { this.busy = name; this.$emit("act", { name, id }); },
    acted() { this.busy = ""; },
    tag(c) {
      if (!c.job) return { text: "new", kind: "" };
      if (c.job.state === "running") return { text: `${Math.round(100 * c.job.progress)} %`, kind: "accent" };
      return { text: c.job.state, kind: c.job.state === "failed" ? "fault" : c.job.state === "succeeded" ? "accent" : "" };
    },
    failed() { if (this.outlines) { this.outlines = false; window.eigenheadSay("fault", "No silhouettes: a camera of this capture has neither a usable clean plate nor a mask."); } },
    step(by) { this.large = (this.large + by + this.current.cameras.length) % this.current.cameras.length; },
    key(event) {
      if (this.large === null) return;
      if (event.key === "Escape") this.large = null;
      else if (event.key === "ArrowLeft") this.step(-1);
      else if (event.key === "ArrowRight") this.step(1);
    },
    drop(event) { this.over = false; this.take(event.dataTransfer.files); },
    async take(files) {
      for (const file of files) {
        const entry = { id: Math.random(), name: file.name, share: 0, state: "0 %", done: false, detail: "", errors: [] };
        this.uploads = [entry, ...this.uploads];
        const mine = this.uploads[0];
        const { status, document } = await send("/console/captures", file, { label: file.name.replace(/\.(zip|tar|tgz|tar\.gz)$/, "") }, (share) => {
          mine.share = share; mine.state = share < 1 ? `${Math.round(100 * share)} %` : "checking";
        });
        mine.done = true;
        if (status === 201) { this.chosen = document.id; this.uploads = this.uploads.filter((u) => u.id !== mine.id); window.eigenheadSay("done", `${file.name} is here.`); }
        else { mine.state = "refused"; mine.detail = document.detail; mine.errors = document.errors || []; }
      }
    },
  },
};
