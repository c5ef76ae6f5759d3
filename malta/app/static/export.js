// A chart as a file: SVG with the styles of the page in it, PNG of twice its size, CSV of what is drawn.

const STYLES = ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "stroke-linejoin", "opacity", "font-size", "font-weight", "font-family"];

// The text of a picture that needs no page: variables and classes are resolved.
export function svgText(picture, background) {
  const copy = picture.cloneNode(true), from = [...picture.querySelectorAll("*")];
  [...copy.querySelectorAll("*")].forEach((node, k) => {
    const style = getComputedStyle(from[k]);
    for (const name of STYLES) node.setAttribute(name, style.getPropertyValue(name));
    node.removeAttribute("class");
  });
  copy.querySelector("defs").insertAdjacentHTML("afterend", `<rect width="100%" height="100%" fill="${background}"/>`);
  return new XMLSerializer().serializeToString(copy);
}

// Every curve and set of points, one row each point; faint ones are of other designs.
export function csvText(view) {
  const quote = (text) => `"${String(text).replaceAll('"', '""')}"`;
  const rows = [...(view.lines ?? []), ...(view.points ?? [])].flatMap((one) => one.xs.map((x, k) => [quote(one.name + (one.faint ? " (beside)" : "")), x ?? "", one.ys[k] ?? ""].join(",")));
  return [["curve", view.x.label, view.y.label].map(quote).join(","), ...rows, ""].join("\r\n");
}

function download(name, blob) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

export function exportChart(kind, name, picture, view, background) {
  if (kind === "csv") { download(`${name}.csv`, new Blob([csvText(view)], { type: "text/csv" })); return; }
  const text = svgText(picture, background), file = new Blob([text], { type: "image/svg+xml" });
  if (kind === "svg") { download(`${name}.svg`, file); return; }
  const image = new Image(), canvas = document.createElement("canvas");
  image.onload = () => {
    [canvas.width, canvas.height] = [2 * image.width, 2 * image.height];
    canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
    canvas.toBlob((blob) => download(`${name}.png`, blob), "image/png");
  };
  image.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
}
