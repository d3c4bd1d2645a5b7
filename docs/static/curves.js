// Draws the figures of the page "Curves to explore" by plotly.js, each when it comes into view.
document.addEventListener("DOMContentLoaded", () => {
  // Where fingers scroll, dragging must not zoom
  const dragmode = matchMedia("(pointer: coarse)").matches ? false : "zoom";
  const seen = new IntersectionObserver((entries) => {
    for (const { target } of entries.filter((entry) => entry.isIntersecting)) {
      seen.unobserve(target);
      const { data, layout } = JSON.parse(document.getElementById(target.dataset.figure).textContent);
      Plotly.newPlot(target, data, { ...layout, dragmode }, { responsive: true, displayModeBar: false });
    }
  }, { rootMargin: "400px" });
  document.querySelectorAll(".curves").forEach((place) => seen.observe(place));
});
