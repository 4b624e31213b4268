//! Methods that RPF grew from and is compared with.
//!
//! | preset | file | what decides how much a pixel counts |
//! |---|---|---|
//! | `unfiltered` | `mean.rs` | only the pixel's own samples do |
//! | `gaussian` | [`gaussian`] | distance (eq. 2) |
//! | `bilateral` | [`bilateral`] | distance and difference in colour (eq. 3, 4) |
//! | `cross-bilateral` | [`cross_bilateral`] | distance, difference in colour, differences in features |
//!
//! All but the first are one loop, in `window.rs`, over the pixels around each pixel. They work on pixels: on the means
//! of each pixel's samples. That is what such filters are applied to in practice, and it is what RPF, which filters
//! samples, has to be better than.

pub mod bilateral;
pub mod cross_bilateral;
pub mod gaussian;
pub(crate) mod mean;
pub(crate) mod window;

#[cfg(test)]
mod tests;
