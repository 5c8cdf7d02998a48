//! Search from coarse to fine.

use super::{ScoreMap, SearchImage, Template, TemplateError, score_map};
use crate::image::Image8;

/// Where a template was found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Peak {
    /// Column of the template's middle, (width - 1) / 2, in the image, px.
    pub u_px: f64,
    /// Row of the template's middle in the image, px.
    pub v_px: f64,
    /// NCC at the best whole pixel, -1 to 1.
    pub score: f64,
}

/// A template at full and reduced resolutions.
#[derive(Clone, Debug)]
pub struct TemplatePyramid {
    levels: Vec<Template>,
}

/// Shortest side of a template at the coarsest level, px.
const MIN_COARSE_SIDE: usize = 6;
/// Local maxima of the coarsest level that are followed to finer levels.
const COARSE_CANDIDATES: usize = 4;

impl TemplatePyramid {
    /// Reduces a template by two as long as its sides keep [`MIN_COARSE_SIDE`] pixels, at most
    /// `max_levels` levels in all; masked pixels (`false`) spoil the means they are part of.
    ///
    /// # Errors
    /// [`TemplateError`] if the full-resolution template cannot be used.
    pub fn new(
        width: usize,
        height: usize,
        values: &[f32],
        mask: Option<&[bool]>,
        max_levels: usize,
    ) -> Result<Self, TemplateError> {
        let mut levels = vec![Template::new(width, height, values, mask)?];
        let (mut w, mut h) = (width, height);
        let mut values = values.to_vec();
        let mut mask = mask.map(<[bool]>::to_vec);
        while levels.len() < max_levels && (w / 2).min(h / 2) >= MIN_COARSE_SIDE {
            let (half_w, half_h) = (w / 2, h / 2);
            let four = |i: usize| {
                let first = 2 * (i / half_w) * w + 2 * (i % half_w);
                [first, first + 1, first + w, first + w + 1]
            };
            let next: Vec<f32> = (0..half_w * half_h)
                .map(|i| four(i).iter().map(|&k| values[k]).sum())
                .collect();
            mask = mask.map(|m| {
                (0..half_w * half_h)
                    .map(|i| four(i).iter().all(|&k| m[k]))
                    .collect()
            });
            (w, h, values) = (half_w, half_h, next);
            match Template::new(w, h, &values, mask.as_deref()) {
                Ok(level) => levels.push(level),
                Err(_) => break, // all contrast is fine detail: the finer levels must do
            }
        }
        Ok(Self { levels })
    }

    /// The template at full resolution.
    #[must_use]
    pub fn full(&self) -> &Template {
        &self.levels[0]
    }
}

/// A rectangle of pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// First column.
    pub left: u32,
    /// First row.
    pub top: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl Window {
    /// The whole of an image.
    #[must_use]
    pub fn whole(image: &Image8) -> Self {
        Self {
            left: 0,
            top: 0,
            width: image.width_px,
            height: image.height_px,
        }
    }

    /// The part of this window inside an image.
    #[must_use]
    pub fn clipped(&self, image: &Image8) -> Self {
        let (left, top) = (self.left.min(image.width_px), self.top.min(image.height_px));
        let right = self.left.saturating_add(self.width).min(image.width_px);
        let bottom = self.top.saturating_add(self.height).min(image.height_px);
        Self {
            left,
            top,
            width: right - left,
            height: bottom - top,
        }
    }
}

/// Finds a template in a window of the image, from the coarsest level of its pyramid to the
/// finest, and refines the peak by a quadratic. The template lies wholly inside the window. `None`
/// if the window (cut at the image border) is smaller than the template.
#[must_use]
pub fn search(image: &Image8, template: &TemplatePyramid, window: Window) -> Option<Peak> {
    search_peaks(image, template, window).into_iter().next()
}

/// Like [`search`], all places that were followed to full resolution, best first; their scores tell
/// whether the best is alone. Empty if the window is smaller than the template.
#[must_use]
pub fn search_peaks(image: &Image8, template: &TemplatePyramid, window: Window) -> Vec<Peak> {
    coarse_to_fine(image, template, window).unwrap_or_default()
}

fn coarse_to_fine(image: &Image8, template: &TemplatePyramid, window: Window) -> Option<Vec<Peak>> {
    let window = window.clipped(image);
    let top_level = template.levels.len() - 1;
    let coarse = SearchImage::new(
        image,
        window.left,
        window.top,
        window.width,
        window.height,
        top_level as u32,
    );
    let map = score_map(
        &coarse,
        &template.levels[top_level],
        0,
        0,
        coarse.width,
        coarse.height,
    )?;
    if top_level == 0 {
        let peaks = map.peaks(COARSE_CANDIDATES).into_iter();
        let all = peaks.map(|(i, j, s)| finish(&template.levels[0], window, &map, i, j, s));
        return Some(all.collect());
    }
    let mut candidates: Vec<(usize, usize, f32)> = map.peaks(COARSE_CANDIDATES);
    for level in (0..top_level).rev() {
        let at_level = &template.levels[level];
        let mut next = Vec::with_capacity(candidates.len());
        for &(x, y, _) in &candidates {
            let left = (2 * x).saturating_sub(2);
            let top = (2 * y).saturating_sub(2);
            let step = 1u32 << level;
            let part = SearchImage::new(
                image,
                window.left + left as u32 * step,
                window.top + top as u32 * step,
                (at_level.width as u32 + 5) * step,
                (at_level.height as u32 + 5) * step,
                level as u32,
            );
            let limit = |start: usize, size: u32, length: usize| {
                ((size as usize >> level) + 1)
                    .saturating_sub(start + length)
                    .min(6)
            };
            let columns = limit(left, window.width, at_level.width);
            let rows = limit(top, window.height, at_level.height);
            let Some(local) = score_map(&part, at_level, 0, 0, columns, rows) else {
                continue;
            };
            let Some((i, j, score)) = local.best() else {
                continue;
            };
            if level == 0 {
                let corner = Window {
                    left: window.left + left as u32,
                    top: window.top + top as u32,
                    ..window
                };
                let peak = finish(at_level, corner, &local, i, j, score);
                next.push(((left + i, top + j, score), Some(peak)));
            } else {
                next.push(((left + i, top + j, score), None));
            }
        }
        next.sort_by(|(a, _), (b, _)| b.2.total_cmp(&a.2).then((a.1, a.0).cmp(&(b.1, b.0))));
        if level == 0 {
            return Some(next.into_iter().filter_map(|(_, peak)| peak).collect());
        }
        // a clear winner is followed alone
        let keep = next
            .iter()
            .filter(|(c, _)| c.2 >= next[0].0.2 - 0.15)
            .count();
        candidates = next.into_iter().take(keep).map(|(c, _)| c).collect();
    }
    None
}

fn finish(
    template: &Template,
    corner: Window,
    map: &ScoreMap,
    i: usize,
    j: usize,
    score: f32,
) -> Peak {
    let (du, dv) = map.refine(i, j);
    let middle = |size: usize| (size as f64 - 1.0) / 2.0;
    Peak {
        u_px: f64::from(corner.left) + (map.left + i) as f64 + middle(template.width) + du,
        v_px: f64::from(corner.top) + (map.top + j) as f64 + middle(template.height) + dv,
        score: f64::from(score),
    }
}
