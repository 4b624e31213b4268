//! What surfaces are made of: where a ray meets them, and a point drawn on them.

use super::vector::{Vec3, vec3};
use std::f64::consts::PI;

/// A ray; `direction` has unit length.
#[derive(Clone, Copy)]
pub(super) struct Ray {
    pub(super) origin: Vec3,
    pub(super) direction: Vec3,
}

/// Hits nearer than this, in scene units, are the surface that the ray starts on. The scenes are some 10 units wide:
/// rounding is about 1e-15 of that.
pub(super) const NEAREST: f64 = 1e-7;

/// A surface at rest at the time 0.
#[derive(Clone, Copy, Debug)]
pub(super) enum Shape {
    /// All points at `radius` from `center`; its outside is its front.
    Sphere { center: Vec3, radius: f64 },
    /// Rectangle; `u_inverse` and `v_inverse` are its edges over their squared lengths.
    Rectangle { corner: Vec3, u: Vec3, v: Vec3, u_inverse: Vec3, v_inverse: Vec3, normal: Vec3 },
    /// Box along the axes.
    Block { low: Vec3, high: Vec3 },
}

impl Shape {
    /// The rectangle from `corner` along `u` and `v`, which are at right angles; its front is the side of u x v.
    pub(super) fn rectangle(corner: Vec3, u: Vec3, v: Vec3) -> Self {
        let (u_inverse, v_inverse) = (u * (1.0 / u.dot(u)), v * (1.0 / v.dot(v)));
        Self::Rectangle { corner, u, v, u_inverse, v_inverse, normal: u.cross(v).normalized() }
    }

    /// Distance to the nearest hit between [`NEAREST`] and `farthest`.
    pub(super) fn intersect(&self, ray: &Ray, farthest: f64) -> Option<f64> {
        let inside = |t: f64| t > NEAREST && t < farthest;
        let Ray { origin, direction } = *ray;
        match *self {
            Self::Sphere { center, radius } => {
                let from = origin - center;
                let (b, c) = (from.dot(direction), from.dot(from) - radius * radius);
                let discriminant = b * b - c;
                if discriminant < 0.0 || (c > 0.0 && b > 0.0) {
                    return None;
                }
                let root = discriminant.sqrt();
                [-b - root, -b + root].into_iter().find(|&t| inside(t))
            }
            Self::Rectangle { corner, u_inverse, v_inverse, normal, .. } => {
                let t = (corner - origin).dot(normal) / normal.dot(direction);
                if !inside(t) {
                    return None;
                }
                let on = origin + direction * t - corner;
                let unit = |a: f64| (0.0..=1.0).contains(&a);
                (unit(on.dot(u_inverse)) && unit(on.dot(v_inverse))).then_some(t)
            }
            Self::Block { low, high } => {
                let slab = |from: f64, along: f64, low: f64, high: f64| {
                    let inverse = 1.0 / along;
                    let (a, b) = ((low - from) * inverse, (high - from) * inverse);
                    if a < b { (a, b) } else { (b, a) }
                };
                let (x0, x1) = slab(origin.x, direction.x, low.x, high.x);
                let (y0, y1) = slab(origin.y, direction.y, low.y, high.y);
                let (z0, z1) = slab(origin.z, direction.z, low.z, high.z);
                let (enter, leave) = (x0.max(y0).max(z0), x1.min(y1).min(z1));
                if enter > leave { None } else { [enter, leave].into_iter().find(|&t| inside(t)) }
            }
        }
    }

    /// The unit normal of the front at a point of the surface.
    pub(super) fn normal(&self, at: Vec3) -> Vec3 {
        match *self {
            Self::Sphere { center, radius } => (at - center) * (1.0 / radius),
            Self::Rectangle { normal, .. } => normal,
            Self::Block { low, high } => {
                let (center, size) = ((low + high) * 0.5, high - low);
                let place = vec3((at.x - center.x) / size.x, (at.y - center.y) / size.y, (at.z - center.z) / size.z);
                let (x, y, z) = (place.x.abs(), place.y.abs(), place.z.abs());
                if x >= y && x >= z {
                    vec3(1.0_f64.copysign(place.x), 0.0, 0.0)
                } else if y >= z {
                    vec3(0.0, 1.0_f64.copysign(place.y), 0.0)
                } else {
                    vec3(0.0, 0.0, 1.0_f64.copysign(place.z))
                }
            }
        }
    }

    /// Area in square units of the shapes that [`Shape::sample`] can draw points on; 0 for the others.
    pub(super) fn area(&self) -> f64 {
        match *self {
            Self::Sphere { radius, .. } => 4.0 * PI * radius * radius,
            Self::Rectangle { u, v, .. } => u.length() * v.length(),
            Self::Block { .. } => 0.0,
        }
    }

    /// A point drawn evenly over the area, and the front's normal there; none on shapes without [`Shape::area`].
    pub(super) fn sample(&self, [a, b]: [f64; 2]) -> Option<(Vec3, Vec3)> {
        match *self {
            Self::Sphere { center, radius } => {
                let z = 1.0 - 2.0 * a;
                let (sine, cosine) = libm::sincos(2.0 * PI * b);
                let ring = (1.0 - z * z).max(0.0).sqrt();
                let normal = vec3(ring * cosine, ring * sine, z);
                Some((center + normal * radius, normal))
            }
            Self::Rectangle { corner, u, v, normal, .. } => Some((corner + u * a + v * b, normal)),
            Self::Block { .. } => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_shapes_where_they_are() {
        let ray = |origin, direction: Vec3| Ray { origin, direction: direction.normalized() };
        let down = ray(vec3(0.2, 5.0, 0.1), vec3(0.0, -1.0, 0.0));
        let block = Shape::Block { low: vec3(-1.0, 0.0, -1.0), high: vec3(1.0, 2.0, 1.0) };
        let rectangle = Shape::rectangle(vec3(-1.0, 3.0, -1.0), vec3(0.0, 0.0, 2.0), vec3(2.0, 0.0, 0.0));
        let sphere = Shape::Sphere { center: vec3(0.2, 1.0, 0.1), radius: 0.5 };
        for (shape, distance) in [(block, 3.0), (rectangle, 2.0), (sphere, 3.5)] {
            let t = shape.intersect(&down, f64::INFINITY).unwrap();
            assert!((t - distance).abs() < 1e-12, "{shape:?}: {t}");
            assert_eq!(shape.normal(down.origin + down.direction * t), vec3(0.0, 1.0, 0.0));
            assert_eq!(shape.intersect(&down, distance - 1e-9), None);
            let away = ray(down.origin, vec3(0.1, 1.0, 0.0));
            assert_eq!(shape.intersect(&away, f64::INFINITY), None);
        }
        let within = ray(vec3(0.0, 1.0, 0.0), vec3(1.0, 0.0, 0.0));
        assert_eq!(block.intersect(&within, f64::INFINITY), Some(1.0));
        let beside = ray(vec3(1.5, 5.0, 0.0), vec3(0.0, -1.0, 0.0));
        assert!(block.intersect(&beside, f64::INFINITY).or(rectangle.intersect(&beside, f64::INFINITY)).is_none());
    }

    #[test]
    fn drawn_points_lie_on_the_shape() {
        let rectangle = Shape::rectangle(vec3(1.0, 2.0, 3.0), vec3(0.0, 0.0, 2.0), vec3(3.0, 0.0, 0.0));
        assert_eq!(rectangle.area(), 6.0);
        let sphere = Shape::Sphere { center: vec3(1.0, 2.0, 3.0), radius: 0.5 };
        for k in 0..100 {
            let numbers = [f64::from(k) / 100.0, f64::from(k * 37 % 100) / 100.0];
            let (point, normal) = sphere.sample(numbers).unwrap();
            assert!(((point - vec3(1.0, 2.0, 3.0)).length() - 0.5).abs() < 1e-12);
            assert!((sphere.normal(point) - normal).length() < 1e-12);
            let (point, _) = rectangle.sample(numbers).unwrap();
            assert_eq!((point.x, point.y, point.z), (1.0 + 3.0 * numbers[1], 2.0, 3.0 + 2.0 * numbers[0]));
        }
    }
}
