//! Rectangles of pixels, and where a tile lies in its image.
//!
//! All coordinates are pixels of the full image; x runs to the right, y downwards, and a rectangle covers
//! `x..x + width` by `y..y + height`.

/// Greatest image width and height, in pixels.
pub const MAX_SIDE: u32 = 1 << 20;

/// A rectangle of pixels in image coordinates.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Rect {
    /// Left edge.
    pub x: u32,
    /// Top edge.
    pub y: u32,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
}

impl Rect {
    /// The rectangle with its corner at (x, y).
    pub const fn new(x: u32, y: u32, width: u32, height: u32) -> Self {
        Self { x, y, width, height }
    }

    /// One past the right edge.
    pub const fn right(&self) -> u32 {
        self.x + self.width
    }

    /// One past the bottom edge.
    pub const fn bottom(&self) -> u32 {
        self.y + self.height
    }

    /// Number of pixels.
    pub const fn area(&self) -> u64 {
        self.width as u64 * self.height as u64
    }

    /// Whether the pixel (x, y) lies inside.
    pub const fn contains(&self, x: u32, y: u32) -> bool {
        x >= self.x && x < self.right() && y >= self.y && y < self.bottom()
    }

    /// Whether all of `other`, which may be of any numbers, lies inside.
    pub const fn covers(&self, other: &Rect) -> bool {
        let wide = other.x >= self.x && other.x <= self.right() && other.width <= self.right() - other.x;
        wide && other.y >= self.y && other.y <= self.bottom() && other.height <= self.bottom() - other.y
    }

    /// The common part of the two, if they overlap.
    pub fn intersection(&self, other: &Rect) -> Option<Rect> {
        let (x, y) = (self.x.max(other.x), self.y.max(other.y));
        let (right, bottom) = (self.right().min(other.right()), self.bottom().min(other.bottom()));
        (x < right && y < bottom).then(|| Rect::new(x, y, right - x, bottom - y))
    }

    /// The parts of it that lie outside of another one, which do not overlap: four at most.
    pub fn without(&self, hole: &Rect) -> impl Iterator<Item = Rect> + use<> {
        // What lies apart from it takes nothing away.
        let hole = self.intersection(hole).unwrap_or(Rect::new(self.x, self.y, 0, 0));
        let Rect { x, y, width, height } = *self;
        let parts = [
            Rect::new(x, y, width, hole.y - y),
            Rect::new(x, hole.y, hole.x - x, hole.height),
            Rect::new(hole.right(), hole.y, self.right() - hole.right(), hole.height),
            Rect::new(x, hole.bottom(), width, y + height - hole.bottom()),
        ];
        parts.into_iter().filter(|part| part.area() > 0)
    }

    /// Grown by `by` pixels on every side, as far as `bounds` allow.
    pub fn grown(&self, by: u32, bounds: &Rect) -> Rect {
        let (x, y) = (self.x.saturating_sub(by).max(bounds.x), self.y.saturating_sub(by).max(bounds.y));
        let right = self.right().saturating_add(by).min(bounds.right());
        let bottom = self.bottom().saturating_add(by).min(bounds.bottom());
        Rect::new(x, y, right - x, bottom - y)
    }

    /// Index of the pixel (x, y), which lies inside, in row-major order.
    pub(crate) const fn index(&self, x: u32, y: u32) -> usize {
        (y - self.y) as usize * self.width as usize + (x - self.x) as usize
    }
}

impl std::fmt::Display for Rect {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "[{}, {}, {}, {}]", self.x, self.y, self.width, self.height)
    }
}

/// Pixels of context around a core on each side.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Halo {
    /// Columns left of the core.
    pub left: u32,
    /// Rows above the core.
    pub top: u32,
    /// Columns right of the core.
    pub right: u32,
    /// Rows below the core.
    pub bottom: u32,
}

impl Halo {
    /// Whether every side is at least as wide as in `other`.
    pub const fn covers(&self, other: &Halo) -> bool {
        self.left >= other.left && self.top >= other.top && self.right >= other.right && self.bottom >= other.bottom
    }
}

/// A geometry that cannot be; says what would be right.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum GeometryError {
    /// The image has no pixels or more than it may.
    #[error("image {0} x {1}: width and height must be 1 to {MAX_SIDE} pixels")]
    Image(u32, u32),
    /// The core has no pixels.
    #[error("tile {0} has no pixels: width and height must be at least 1")]
    Empty(Rect),
    /// The core sticks out of the image.
    #[error("tile [{}, {}, {}, {}] does not lie inside the image of {} x {} pixels", core[0], core[1], core[2], core[3], image[0], image[1])]
    Outside {
        /// x, y, width, height of the core.
        core: [u32; 4],
        /// Width and height of the image.
        image: [u32; 2],
    },
    /// The halo sticks out of the image.
    #[error(
        "halo [{}, {}, {}, {}] reaches outside the image: at most [{}, {}, {}, {}] fits around this tile",
        halo.left, halo.top, halo.right, halo.bottom, fits.left, fits.top, fits.right, fits.bottom
    )]
    Halo {
        /// The halo that was given.
        halo: Halo,
        /// The widest halo that stays inside the image.
        fits: Halo,
    },
}

/// Where a tile lies: its core (the pixels it answers for) and the halo (the pixels of context that it also holds).
/// The data window, core plus halo, lies inside the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct TileGeometry {
    image: Rect,
    core: Rect,
    halo: Halo,
}

impl TileGeometry {
    /// Checks and makes a geometry from the image's width and height, the core, and the halo.
    pub fn new(image: [u32; 2], core: Rect, halo: Halo) -> Result<Self, GeometryError> {
        let [width, height] = image;
        if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
            return Err(GeometryError::Image(width, height));
        }
        if core.width == 0 || core.height == 0 {
            return Err(GeometryError::Empty(core));
        }
        let fits = |start: u32, size: u32, limit: u32| start.checked_add(size).is_some_and(|end| end <= limit);
        if !fits(core.x, core.width, width) || !fits(core.y, core.height, height) {
            return Err(GeometryError::Outside { core: [core.x, core.y, core.width, core.height], image });
        }
        let image = Rect::new(0, 0, width, height);
        let fits = widest_halo(&image, &core, u32::MAX);
        if !fits.covers(&halo) {
            return Err(GeometryError::Halo { halo, fits });
        }
        Ok(Self { image, core, halo })
    }

    /// A core with `halo` pixels around it, fewer where the image ends.
    pub fn with_halo(image: [u32; 2], core: Rect, halo: u32) -> Result<Self, GeometryError> {
        let bare = Self::new(image, core, Halo::default())?;
        Ok(Self { halo: widest_halo(&bare.image, &core, halo), ..bare })
    }

    /// The whole image as one rectangle at (0, 0).
    pub const fn image(&self) -> Rect {
        self.image
    }

    /// The pixels this tile answers for.
    pub const fn core(&self) -> Rect {
        self.core
    }

    /// The context around the core.
    pub const fn halo(&self) -> Halo {
        self.halo
    }

    /// The data window: core plus halo.
    pub const fn window(&self) -> Rect {
        let Self { core, halo, .. } = self;
        Rect::new(
            core.x - halo.left,
            core.y - halo.top,
            core.width + halo.left + halo.right,
            core.height + halo.top + halo.bottom,
        )
    }

    /// The halo that a method with this reach reads around the core: `reach` on every side, less at the image's edge.
    pub fn halo_for(&self, reach: u32) -> Halo {
        widest_halo(&self.image, &self.core, reach)
    }
}

/// The widest halo of at most `limit` pixels that stays inside the image.
fn widest_halo(image: &Rect, core: &Rect, limit: u32) -> Halo {
    Halo {
        left: core.x.min(limit),
        top: core.y.min(limit),
        right: (image.width - core.right()).min(limit),
        bottom: (image.height - core.bottom()).min(limit),
    }
}

/// The tiles of `size` x `size` pixels (smaller at the right and bottom edge) that cover an image, row by row.
pub fn tiling(image: [u32; 2], size: u32) -> impl Iterator<Item = Rect> {
    let [width, height] = image;
    let step = size.max(1);
    (0..height.div_ceil(step)).flat_map(move |row| {
        (0..width.div_ceil(step)).map(move |column| {
            let (x, y) = (column * step, row * step);
            Rect::new(x, y, step.min(width - x), step.min(height - y))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn window_is_core_plus_halo() {
        let halo = Halo { left: 3, top: 2, right: 4, bottom: 1 };
        let geometry = TileGeometry::new([100, 50], Rect::new(10, 20, 30, 15), halo).unwrap();
        assert_eq!(geometry.window(), Rect::new(7, 18, 37, 18));
        assert_eq!(geometry.halo_for(12), Halo { left: 10, top: 12, right: 12, bottom: 12 });
    }

    #[test]
    fn without_a_hole_the_rest_is_left() {
        let rect = Rect::new(3, 2, 4, 5);
        for (x, y) in (0..9).flat_map(|x| (0..9).map(move |y| (x, y))) {
            for (width, height) in [(1, 1), (4, 5), (9, 2), (2, 9), (9, 9)] {
                let hole = Rect::new(x, y, width, height);
                assert_eq!(rect.covers(&hole), hole.without(&rect).count() == 0);
                let parts: Vec<Rect> = rect.without(&hole).collect();
                assert!(parts.len() <= 4 && parts.iter().all(|part| part.area() > 0));
                for (x, y) in (0..9).flat_map(|x| (0..9).map(move |y| (x, y))) {
                    let times = parts.iter().filter(|part| part.contains(x, y)).count();
                    assert_eq!(times, usize::from(rect.contains(x, y) && !hole.contains(x, y)), "{hole}: {x}, {y}");
                }
            }
        }
    }

    #[test]
    fn numbers_that_wrap_around_are_not_inside() {
        let image = Rect::new(0, 0, 40, 30);
        assert!(image.covers(&image) && image.covers(&Rect::new(40, 30, 0, 0)));
        assert!(!image.covers(&Rect::new(30, 0, u32::MAX - 20, 1)) && !image.covers(&Rect::new(0, u32::MAX, 1, 2)));
    }

    #[test]
    fn limits_are_exact() {
        let ok = |image, core, halo| TileGeometry::new(image, core, halo);
        let none = Halo::default();
        assert!(ok([MAX_SIDE, 1], Rect::new(0, 0, 1, 1), none).is_ok());
        assert!(matches!(ok([MAX_SIDE + 1, 1], Rect::new(0, 0, 1, 1), none), Err(GeometryError::Image(..))));
        assert!(matches!(ok([0, 1], Rect::new(0, 0, 1, 1), none), Err(GeometryError::Image(..))));
        assert!(matches!(ok([4, 4], Rect::new(0, 0, 0, 1), none), Err(GeometryError::Empty(_))));
        assert!(ok([4, 4], Rect::new(3, 3, 1, 1), none).is_ok());
        assert!(matches!(ok([4, 4], Rect::new(3, 3, 2, 1), none), Err(GeometryError::Outside { .. })));
        assert!(matches!(ok([4, 4], Rect::new(u32::MAX, 3, 2, 1), none), Err(GeometryError::Outside { .. })));
        let halo = |left, right| Halo { left, right, ..none };
        assert!(ok([4, 4], Rect::new(1, 1, 1, 1), halo(1, 2)).is_ok());
        for bad in [halo(2, 0), halo(0, 3), halo(u32::MAX, 0), halo(0, u32::MAX)] {
            assert!(matches!(ok([4, 4], Rect::new(1, 1, 1, 1), bad), Err(GeometryError::Halo { .. })));
        }
    }

    #[test]
    fn tiling_covers_each_pixel_once() {
        let mut seen = [0; 7 * 5];
        for tile in tiling([7, 5], 3) {
            for y in tile.y..tile.bottom() {
                for x in tile.x..tile.right() {
                    seen[(y * 7 + x) as usize] += 1;
                }
            }
        }
        assert!(seen.iter().all(|&n| n == 1));
    }
}
