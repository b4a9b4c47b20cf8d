"use strict";
(() => {
  Bokeh.logger.set_level("error");
  const touch = matchMedia("(pointer: coarse)").matches;

  // drawings stand in shadow trees of their own
  const name = (root, text) => {
    for (const part of root.querySelectorAll("*")) {
      if (part.tagName === "CANVAS") {
        part.setAttribute("role", "img");
        part.setAttribute("aria-label", text);
      }
      if (part.shadowRoot) name(part.shadowRoot, text);
    }
  };

  // with a mouse, the wheel and a drag may zoom; with a finger they scroll the page until asked
  const activate = (model) => {
    for (const tool of model.toolbar.tools) {
      const kind = (tool.tools ? tool.tools[0] : tool).type;
      if (kind === "WheelZoomTool" || kind === "BoxZoomTool") tool.active = !touch;
    }
  };

  const open = async (figure, place) => {
    const item = JSON.parse(figure.querySelector("script").textContent);
    const views = await Bokeh.embed.embed_item(item, place.id);
    const view = views.get_by_id ? views.get_by_id(item.root_id) : views[0];
    activate(view.model);
    await view.ready;
    name(place, place.getAttribute("aria-label"));
  };

  for (const figure of document.querySelectorAll("figure.zoomable")) {
    const button = figure.querySelector("button");
    const place = figure.querySelector(".zoom");
    button.hidden = false;
    button.addEventListener("click", async () => {
      const shown = figure.classList.toggle("open");
      button.setAttribute("aria-expanded", shown);
      button.textContent = shown ? "Back to the picture" : "Zoom and read values";
      if (shown && !place.childElementCount) await open(figure, place);
    });
  }
})();
