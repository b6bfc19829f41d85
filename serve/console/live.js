// Takes pictures of a webcam or a film, each after the answer to the previous picture.

const ROWS = 420; // twice the model's rows; the service would scale a larger picture down
const QUALITY = 0.92, WAIT_MS = 30;

// `answer`: sends {body, image} and returns after the answer; `told`: shows an error text.
export function createLive(video, answer, told) {
  const canvas = document.createElement("canvas");
  let running = 0; // number of the current run; an older run ends when it differs

  // The current picture of the video, as a JPEG of at most `ROWS` rows.
  async function take() {
    const scale = Math.min(1, ROWS / video.videoHeight);
    canvas.width = Math.round(video.videoWidth * scale);
    canvas.height = Math.round(video.videoHeight * scale);
    canvas.getContext("2d").drawImage(video, 0, 0, canvas.width, canvas.height);
    return new Promise((resolve) => canvas.toBlob(resolve, "image/jpeg", QUALITY));
  }

  const nextFrame = () => new Promise((resolve) => {
    if (video.requestVideoFrameCallback) video.requestVideoFrameCallback(resolve);
    setTimeout(resolve, 10 * WAIT_MS); // a paused or ended video has no next frame
    if (!video.requestVideoFrameCallback) setTimeout(resolve, WAIT_MS);
  });

  async function run() {
    const own = ++running;
    await video.play();
    while (own === running && !video.ended) {
      if (video.videoHeight) {
        const body = await take();
        if (own !== running) return;
        await answer({ body, image: canvas, truth: null });
      }
      if (video.ended) break;
      await nextFrame();
    }
    if (own === running) stop();
  }

  function stop() {
    running += 1;
    video.pause();
    video.srcObject?.getTracks().forEach((track) => track.stop());
    video.srcObject = null;
    if (video.src) URL.revokeObjectURL(video.src);
    video.removeAttribute("src");
    video.dispatchEvent(new Event("stopped"));
  }

  async function begin(open, failed) {
    stop();
    try {
      await open();
      video.dispatchEvent(new Event("started"));
      await run();
    } catch (error) {
      stop();
      told(`${failed}: ${error.message}`);
    }
  }

  return {
    stop,
    webcam: () => begin(async () => {
      if (!navigator.mediaDevices) throw new Error("browsers allow it only on pages of localhost or HTTPS");
      const wanted = { width: { ideal: 1280 }, height: { ideal: 720 }, facingMode: "environment" };
      video.srcObject = await navigator.mediaDevices.getUserMedia({ video: wanted, audio: false });
    }, "no webcam"),
    film: (file) => begin(async () => {
      video.src = URL.createObjectURL(file);
      await new Promise((resolve, reject) => {
        video.onloadeddata = resolve;
        video.onerror = () => reject(new Error(video.error?.message || "unknown format"));
      });
      video.onerror = null;
    }, "the browser cannot play this film"),
  };
}
