//! A thin-lens camera.

use super::shape::Ray;
use super::vector::{Vec3, vec3};
use std::f64::consts::PI;

/// Looks from a point at a point; the lens is a disc around the eye (pbrt 4th ed., 5.2.3).
#[derive(Clone, Copy, Debug)]
pub(super) struct Camera {
    eye: Vec3,
    forward: Vec3,
    right: Vec3,
    up: Vec3,
    /// Tangent of half the field of view over the image's shorter side.
    half_view: f64,
    aperture: f64,
    focus: f64,
}

impl Camera {
    /// A pinhole camera whose field of view covers `degrees` over the shorter side of the image. It must not look
    /// straight up or down.
    pub(super) fn new(eye: Vec3, target: Vec3, degrees: f64) -> Self {
        let forward = (target - eye).normalized();
        let right = forward.cross(vec3(0.0, 1.0, 0.0)).normalized();
        let half_view = libm::tan(degrees * PI / 360.0);
        Self { eye, forward, right, up: right.cross(forward), half_view, aperture: 0.0, focus: 1.0 }
    }

    /// With a lens of radius `aperture` focused at the distance `focus`, both in scene units.
    pub(super) fn with_lens(self, aperture: f64, focus: f64) -> Self {
        Self { aperture, focus, ..self }
    }

    /// Whether rays depend on the lens numbers.
    pub(super) fn has_lens(&self) -> bool {
        self.aperture > 0.0
    }

    /// The ray through a film position (pixels, y down) of an image of `size` pixels and a point of the lens.
    pub(super) fn ray(&self, film: [f64; 2], [width, height]: [u32; 2], lens: [f64; 2]) -> Ray {
        let scale = 2.0 * self.half_view / f64::from(width.min(height));
        let (x, y) = ((film[0] - 0.5 * f64::from(width)) * scale, (film[1] - 0.5 * f64::from(height)) * scale);
        let through = self.forward + self.right * x - self.up * y;
        if !self.has_lens() {
            return Ray { origin: self.eye, direction: through.normalized() };
        }
        let radius = self.aperture * lens[0].sqrt();
        let (sine, cosine) = libm::sincos(2.0 * PI * lens[1]);
        let offset = self.right * (radius * cosine) + self.up * (radius * sine);
        Ray { origin: self.eye + offset, direction: (through * self.focus - offset).normalized() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_of_a_film_point_meet_at_the_focus() {
        let camera = Camera::new(vec3(0.0, 1.0, 5.0), vec3(0.0, 1.0, 0.0), 40.0).with_lens(0.2, 5.0);
        let at_focus = |lens| {
            let Ray { origin, direction } = camera.ray([30.0, 7.0], [64, 48], lens);
            assert!((origin - camera.eye).length() <= 0.2);
            origin + direction * ((0.0 - origin.z) / direction.z)
        };
        let expected = at_focus([0.0, 0.0]);
        for lens in [[0.9, 0.1], [0.5, 0.5], [0.99, 0.8]] {
            assert!((at_focus(lens) - expected).length() < 1e-12);
        }
        // The top of a square image looks up by half the field of view.
        let pinhole = Camera::new(vec3(0.0, 1.0, 5.0), vec3(0.0, 1.0, 0.0), 40.0);
        let top = pinhole.ray([32.0, 0.0], [64, 64], [0.0, 0.0]).direction;
        assert!((top.y - libm::sin(20.0 * PI / 180.0)).abs() < 1e-12 && top.x.abs() < 1e-12);
    }
}
