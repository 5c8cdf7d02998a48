//! What the pages of runs, campaigns and studies have in common: the frame of a self-contained HTML
//! page, its style and colours, and [`plot`]s as SVG.

pub mod plot;

const STYLE: &str = include_str!("page.css");

/// The first of the colours that remain distinct for colour-blind readers.
pub const BLUE: &str = "#0072b2";
/// The second.
pub const ORANGE: &str = "#d55e00";
/// The third.
pub const GREEN: &str = "#009e73";
/// The fourth.
pub const PURPLE: &str = "#aa4499";
/// For marks over pictures.
pub const YELLOW: &str = "#ffd21f";

/// A self-contained page; `title` is text, `body` and `footer` are HTML.
pub fn document(title: &str, body: &str, footer: &str) -> String {
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <title>{}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\
         <footer>{footer}</footer>\n</main></body></html>\n",
        escape(title)
    )
}

/// A headed part of a page; `title` and `content` are HTML.
pub fn section(title: &str, content: &str) -> String {
    format!("<section><h2>{title}</h2>\n{content}\n</section>\n")
}

/// Text as HTML.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
        .replace('"', "&quot;")
}
