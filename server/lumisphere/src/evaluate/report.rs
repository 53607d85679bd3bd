//! A sweep as one HTML page: its conditions, the chart, every row, and the first view's pictures. It reads nothing but the pictures beside it,
//! so it works from a folder; it follows the reader's light or dark setting.

use std::fmt::Write;

use super::chart::{chart, on_front};
use super::sweep::bytes_text;
use super::{Group, Metric, Sweep, SweepRow};
use crate::charts::{ChartError, svg};

/// The page. Pictures are looked for as [`picture_path`] says, relative to it.
pub fn report(sweep: &Sweep, metric: Metric) -> Result<String, ChartError> {
    let chart = svg(&chart(sweep, metric))?;
    let (labels, on_front) = (sweep.labels(), on_front(sweep, metric));
    let mut page = Page { html: String::new(), sweep, labels: &labels, on_front: &on_front };
    page.put(HEAD);
    page.put("<h1>Error against time</h1>\n");
    page.conditions(metric);
    page.put("<figure class=\"chart\">\n");
    // The document's own first line is for files.
    page.put(chart.find("<svg").map_or("", |at| &chart[at..]));
    page.put("</figure>\n");
    for group in sweep.groups() {
        page.group(&group);
    }
    page.put(SORT);
    page.put("</main>\n</html>\n");
    Ok(page.html)
}

/// Where a picture of a row lies, relative to the report; `/` between folders.
pub fn picture_path(row: &SweepRow, picture: &str) -> String {
    format!("images/{}/{picture}.png", row.dataset)
}

const HEAD: &str = r#"<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Lumisphere sweep</title>
<style>
:root { color-scheme: light dark; --line: #ddd; --faint: #666; --card: #f6f6f6; --front: #e3f1e8; }
@media (prefers-color-scheme: dark) { :root { --line: #444; --faint: #aaa; --card: #1d1d1d; --front: #1c3326; } }
body { font: 15px/1.45 system-ui, sans-serif; margin: 0; }
main { max-width: 1240px; margin: 0 auto; padding: 1.5rem; }
h1 { font-size: 1.5rem; margin: 0 0 .5rem; }
h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: 0 0 1rem; }
dt, .faint { color: var(--faint); }
dd { margin: 0; }
.chart { margin: 0; padding: .5rem; background: #fff; border: 1px solid var(--line); border-radius: 6px; }
.chart svg { display: block; width: 100%; height: auto; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th { cursor: pointer; font-weight: 600; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; }
tr.front td { background: var(--front); }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 1rem; }
.pictures figure { margin: 0; padding: .5rem; background: var(--card); border-radius: 6px; }
.pair { display: flex; gap: .25rem; }
.pair img { flex: 1 1 0; min-width: 0; width: 100%; height: auto; image-rendering: auto; }
figcaption { font-size: .85rem; margin-top: .3rem; }
</style>
<main>
"#;

/// A click on a column's head sorts by it, a second click the other way.
const SORT: &str = r#"<script>
for (const head of document.querySelectorAll("th")) head.onclick = () => {
  const body = head.closest("table").tBodies[0], column = head.cellIndex, down = head.dataset.down = head.dataset.down === "1" ? "0" : "1";
  const key = (row) => row.cells[column].dataset.v;
  const order = (a, b) => isNaN(key(a)) || isNaN(key(b)) ? key(a).localeCompare(key(b)) : key(a) - key(b);
  body.append(...[...body.rows].sort((a, b) => down === "1" ? order(a, b) : order(b, a)));
};
</script>
"#;

struct Page<'a> {
    html: String,
    sweep: &'a Sweep,
    labels: &'a [String],
    on_front: &'a [bool],
}

/// A column after the first: its head, its number in a row and how many digits it shows.
type Column = (&'static str, fn(&SweepRow) -> Option<f64>, usize);

const COLUMNS: [Column; 11] = [
    ("ΔE2000 mean", |r| Some(r.error.delta_e_2000_mean), 3),
    ("ΔE2000 p95", |r| Some(r.error.delta_e_2000_p95), 3),
    ("FLIP", |r| Some(r.error.flip_mean), 4),
    ("SSIM", |r| r.error.ssim, 4),
    ("PSNR, dB", |r| r.error.psnr_db, 2),
    ("RMSE L*/100", |r| Some(r.error.rmse_lab[0]), 4),
    ("RMSE RGB", |r| Some(Metric::RmseRgb.error(&r.error)), 4),
    ("ms, median", |r| Some(r.millis_per_frame), 2),
    ("ms, p95", |r| Some(r.millis_per_frame_p95), 2),
    ("MB on disk", |r| Some(r.dataset_bytes as f64 / 1e6), 2),
    ("MB on the GPU", |r| r.gpu_bytes.map(|b| b as f64 / 1e6), 2),
];

impl Page<'_> {
    fn put(&mut self, html: &str) {
        self.html.push_str(html);
    }

    fn conditions(&mut self, metric: Metric) {
        let c = &self.sweep.conditions;
        let datasets: Vec<&SweepRow> =
            self.sweep.rows.iter().collect::<Vec<_>>().chunk_by(|a, b| a.dataset == b.dataset).map(|rows| rows[0]).collect();
        let bytes: u64 = datasets.iter().map(|r| r.dataset_bytes).sum();
        let size = c.size.as_deref().map(|s| format!(" of {s} pixels")).unwrap_or_default();
        let pairs = [
            ("Rows", format!("{} of {} datasets ({} together)", self.sweep.rows.len(), datasets.len(), bytes_text(bytes))),
            ("Views", format!("{} held-out views{size}", c.views)),
            (
                "Truth",
                format!("path-traced, {} paths a pixel of the object (fewer around it, where nothing counts)", c.truth_samples_per_pixel),
            ),
            ("Time", format!("{} frames a view after one that does not count", c.timed_frames_per_view)),
            ("Renderer", format!("{}; lumisphere-server {}", c.adapter.as_deref().unwrap_or("CPU"), c.server)),
            ("Chart", format!("{}, against the median time of a frame", metric.label())),
        ];
        self.put("<dl>\n");
        for (name, value) in pairs {
            let _ = writeln!(self.html, "<dt>{}</dt><dd>{}</dd>", escaped(name), escaped(&value));
        }
        self.put("</dl>\n");
    }

    fn group(&mut self, group: &Group) {
        let _ = writeln!(self.html, "<h2>{}</h2>", escaped(&group.name()));
        self.put("<div class=\"wide\"><table>\n<thead><tr><th>setting</th>");
        for (head, _, _) in COLUMNS {
            let _ = write!(self.html, "<th>{}</th>", escaped(head));
        }
        self.put("</tr></thead>\n<tbody>\n");
        for i in &group.rows {
            self.table_row(*i);
        }
        self.put(
            "</tbody></table></div>\n<p class=\"faint\">Shaded: on the front of error and time. A click on a column's head sorts.</p>\n",
        );
        self.pictures(group);
    }

    fn table_row(&mut self, i: usize) {
        let (row, label) = (&self.sweep.rows[i], escaped(&self.labels[i]));
        let class = if self.on_front[i] { " class=\"front\"" } else { "" };
        let _ = write!(self.html, "<tr{class}><td data-v=\"{label}\">{label}</td>");
        for (_, value, digits) in COLUMNS {
            let _ = match value(row) {
                Some(value) => write!(self.html, "<td data-v=\"{value}\">{value:.digits$}</td>"),
                None => write!(self.html, "<td data-v=\"\">-</td>"),
            };
        }
        self.put("</tr>\n");
    }

    // A truth once for all rows that share it: it belongs to a scene and a view, not to a dataset.
    fn pictures(&mut self, group: &Group) {
        self.put("<div class=\"pictures\">\n");
        if let Some(row) = group.rows.first().map(|i| &self.sweep.rows[*i]) {
            let truth = picture_path(row, &row.pictures.truth);
            self.figure(&[(truth, "truth")], "truth, first view");
        }
        for i in &group.rows {
            let row = &self.sweep.rows[*i];
            let pair = [(picture_path(row, &row.pictures.frame), "frame"), (picture_path(row, &row.pictures.error), "absolute error")];
            let caption = format!("{}: frame and absolute error; ΔE2000 {:.3}", self.labels[*i], row.error.delta_e_2000_mean);
            self.figure(&pair, &caption);
        }
        self.put("</div>\n");
    }

    fn figure(&mut self, pictures: &[(String, &str)], caption: &str) {
        self.put("<figure><div class=\"pair\">");
        for (path, what) in pictures {
            let _ = write!(self.html, "<img loading=\"lazy\" src=\"{}\" alt=\"{}\">", escaped(&url(path)), escaped(what));
        }
        let _ = writeln!(self.html, "</div><figcaption>{}</figcaption></figure>", escaped(caption));
    }
}

/// Text within an element or a quoted attribute.
fn escaped(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            _ => safe.push(c),
        }
    }
    safe
}

/// A relative path as a reference: what is not a plain character is percent-encoded, so that no name becomes a scheme or a query.
fn url(path: &str) -> String {
    let plain = |b: &u8| b.is_ascii_alphanumeric() || b"-._/".contains(b);
    path.bytes().map(|b| if plain(&b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect()
}

#[cfg(test)]
mod tests {
    use super::super::sweep::tests::{row, sweep};
    use super::*;

    #[test]
    fn the_page_has_the_chart_every_row_and_every_picture() {
        let sweep = sweep(vec![row("distance", "32", 4.0, 2.0, 1_000_000), row("normal", "64", 2.0, 8.0, 4_000_000)]);
        let page = report(&sweep, Metric::DeltaE).unwrap();
        assert_eq!((page.matches("<svg").count(), page.matches("<tr class=\"front\">").count()), (1, 2));
        // A truth, and two pictures a row.
        assert_eq!(page.matches("<img").count(), 5);
        for part in ["distance, face 32", "images/64/view-00-mirror-normal-error.png", "5.0 MB together", "160 × 120", "2.000"] {
            assert!(page.contains(part), "no {part} in {page}");
        }
        assert!(!page.contains("<?xml"), "a file's first line in the middle of a page");
        // Nothing is fetched from elsewhere.
        assert!(!page.contains("//") || page.matches("//").count() == page.matches("http://www.w3.org/2000/svg").count());
    }

    #[test]
    fn no_string_from_the_data_is_markup() {
        let evil = "<script>alert('\"&')</script>";
        let mut bad = row("distance", "32", 4.0, 2.0, 1);
        (bad.scene, bad.object, bad.blend, bad.truth, bad.dataset) =
            (evil.into(), evil.into(), Some(evil.into()), evil.into(), evil.into());
        bad.variant.insert(evil.into(), evil.into());
        (bad.pictures.truth, bad.pictures.frame) = (evil.into(), "javascript:alert(1)//../x".into());
        let mut sweep = sweep(vec![bad, row("normal", "64", 2.0, 8.0, 1)]);
        (sweep.conditions.adapter, sweep.conditions.server, sweep.conditions.size) = (Some(evil.into()), evil.into(), Some(evil.into()));
        let page = report(&sweep, Metric::DeltaE).unwrap();
        // The page's own script is the only one.
        assert_eq!(page.matches("<script").count(), 1);
        assert!(!page.contains("alert('") && !page.contains("javascript:"));
        assert!(page.contains("&lt;script&gt;alert(&#39;&quot;&amp;&#39;)&lt;/script&gt;"));
    }
}
