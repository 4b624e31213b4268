//! What must not change the image, or not more than another seed would.

use super::samples::Samples;
use super::{Against, Back, Base, Bounds, Case};
use crate::filter::Role;

const FEATURE: Role = Role::Feature { position: false };

/// All of them.
pub(super) fn cases() -> Vec<Case> {
    let exactly = |reason| Bounds::usual(Against::Exactly, reason);
    // Two images of 768 values with a few bright pixels each: their distance itself varies by a half or so.
    let seeds = |reason| Bounds::usual(Against::Seeds(2.0), reason);
    let constant = |name: &'static str, role: Role| {
        Case::new(
            format!("constant-{name}"),
            Base::Image,
            exactly("a constant has no information and no distance, and rejects nothing"),
            move |s| s.add("constant", role, vec![0.3; s.total()]),
        )
    };
    vec![
        constant("feature", FEATURE),
        constant("position", Role::Feature { position: true }),
        constant("random", Role::Random { uniform: true }),
        Case::new(
            "features-constant",
            Base::NoFeatures,
            exactly("features that say nothing are as good as none"),
            |s| {
                s.add("depth", FEATURE, vec![7.5; s.total()]);
                s.add("P", Role::Feature { position: true }, vec![1e30; s.total()]);
                s.add("gone", FEATURE, vec![f32::NAN; s.total()]);
            },
        ),
        Case::new("samples-permuted", Base::Image, seeds("draws then meet other samples, as with another seed"), |s| {
            let order: Vec<usize> = (0..s.total()).map(|i| i / 4 * 4 + (i + i / 4) % 4).collect();
            s.reorder(&order);
        }),
        Case::new("channels-permuted", Base::Image, seeds("sums run in another order"), |s| {
            let mut planes = std::mem::take(&mut s.planes);
            for channel in &s.channels {
                // The last channel's planes become the first.
                let rest = planes.split_off(channel.components as usize);
                s.planes.splice(0..0, planes);
                planes = rest;
            }
            s.channels.reverse();
        }),
        Case::new("colors-permuted", Base::Image, seeds("sums over the channels run in another order"), |s| {
            if let [r, g, b] = &mut s.channel("color")[..] {
                // R, G, B are what B, R, G were.
                std::mem::swap(*r, *g);
                std::mem::swap(*r, *b);
            }
        })
        .back(Back::Rotated),
        Case::new("mirrored", Base::Image, seeds(MOVED), |s| {
            move_pixels(s, |x, y, [width, _]| (width - 1 - x, y));
            let width = s.size[0] as f32;
            s.channel("film")[0].iter_mut().for_each(|v| *v = width - *v);
        })
        .back(Back::Mirrored),
        Case::new("flipped", Base::Image, seeds(MOVED), |s| {
            move_pixels(s, |x, y, [_, height]| (x, height - 1 - y));
            let height = s.size[1] as f32;
            s.channel("film")[1].iter_mut().for_each(|v| *v = height - *v);
        })
        .back(Back::Flipped),
        Case::new("transposed", Base::Image, seeds(MOVED), |s| {
            move_pixels(s, |x, y, _| (y, x));
            if let [x, y] = &mut s.channel("film")[..] {
                std::mem::swap(*x, *y);
            }
        })
        .back(Back::Transposed),
    ]
}

const MOVED: &str = "draws fall on other sides, and the grid's nodes lie elsewhere";

/// Brings to pixel (x, y) what was at `from(x, y, size)`.
fn move_pixels(s: &mut Samples, from: impl Fn(usize, usize, [usize; 2]) -> (usize, usize)) {
    let size = s.size.map(|side| side as usize);
    let order: Vec<usize> = (0..s.total())
        .map(|i| {
            let (x, y) = from(i / 4 % size[0], i / 4 / size[0], size);
            4 * (y * size[0] + x) + i % 4
        })
        .collect();
    s.reorder(&order);
}
