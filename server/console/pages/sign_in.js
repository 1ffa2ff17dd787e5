import { say, spoken } from "/console/static/language.js";

export default spoken({
  emits: ["key"],
  data: () => ({ key: "", fault: "", busy: false }),
  template: `
    <div style="height: 100vh; display: grid; place-items: center">
      <form class="panel pad stack" style="width: 26rem" @submit.prevent="send">
        <h1>eigenhead</h1>
        <p class="muted">This service asks for an API key. It stays between this browser and the service.</p>
        <label class="field">API key<input ref="key" v-model="key" type="password" autocomplete="off"
          placeholder="eh_..." spellcheck="false">
        </label>
        <p class="fault small" role="alert" style="min-height: 1.3em">{{ say(fault) }}</p>
        <button class="b main-action" :disabled="busy || !key"
          style="justify-content: center">{{ say(busy ? 'Looking ...' : 'Sign in') }}</button>
      </form>
    </div>`,
  mounted() {
    document.title = `${say("Sign in")} - eigenhead`;
    this.$refs.key.focus();
  },
  methods: {
    send() {
      this.busy = true;
      this.fault = "";
      this.$emit("key", this.key);
    },
    refuse(text) {
      this.busy = false;
      this.fault = text;
      this.key = "";
      this.$nextTick(() => this.$refs.key.focus());
    },
  },
});
