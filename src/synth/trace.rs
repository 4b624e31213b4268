//! The path tracer: unidirectional, with light sampling at every vertex.
//!
//! Both ways to reach a light, drawing a point on it and happening to hit it, are weighted by the balance heuristic
//! (Veach and Guibas, *Optimally Combining Sampling Techniques*, SIGGRAPH 95), so that together they count it once.
//! Paths end after a fixed number of segments and are never cut at random: a sample's only random numbers are those of
//! [`Numbers`], in fixed dimensions.

use super::material::Bsdf;
use super::random::Numbers;
use super::scene::Scene;
use super::shape::{NEAREST, Ray};
use super::vector::{Frame, Vec3};

/// Where a path met a surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    pub(super) position: Vec3,
    /// Unit normal on the side that was hit.
    pub(super) normal: Vec3,
    pub(super) albedo: Vec3,
}

/// One sample: all that a tile can hold of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    /// Position in the pixel, 0..1.
    pub(super) film: [f64; 2],
    pub(super) lens: [f64; 2],
    pub(super) time: f64,
    /// The numbers for the light point seen from the first hit.
    pub(super) light: [f64; 2],
    /// The numbers for the direction in which the path left the first hit.
    pub(super) bsdf: [f64; 2],
    pub(super) color: Vec3,
    pub(super) first: Option<Hit>,
    pub(super) second: Option<Hit>,
}

/// Dimensions of the random numbers; segment k uses two more from `FIRST_SEGMENT + 2 k` on.
const FILM: u32 = 0;
const LENS: u32 = 1;
const TIME: u32 = 2;
const FIRST_SEGMENT: u32 = 3;

impl Scene {
    /// The sample with these numbers in the pixel (x, y) of an image of `size` pixels.
    pub(super) fn sample(&self, size: [u32; 2], x: u32, y: u32, numbers: Numbers) -> Sample {
        let film = numbers.pair(FILM);
        let lens = if self.camera.has_lens() { numbers.pair(LENS) } else { [0.0; 2] };
        let time = if self.moves() { numbers.pair(TIME)[0] } else { 0.0 };
        let ray = self.camera.ray([f64::from(x) + film[0], f64::from(y) + film[1]], size, lens);
        let light = numbers.pair(FIRST_SEGMENT);
        let bsdf = numbers.pair(FIRST_SEGMENT + 1);
        let mut sample = Sample { film, lens, time, light, bsdf, color: Vec3::ZERO, first: None, second: None };
        self.follow(ray, numbers, &mut sample);
        sample
    }

    /// Follows a path and adds up its light.
    fn follow(&self, mut ray: Ray, numbers: Numbers, sample: &mut Sample) {
        let time = sample.time;
        let mut throughput = Vec3::ONE;
        // Density with which the ray's direction was drawn; none for the camera's, which lights cannot be drawn for.
        let mut drawn_density = None;
        for segment in 0..self.segments {
            let Some((which, distance)) = self.nearest(&ray, time) else {
                sample.color += throughput.times(self.sky);
                return;
            };
            let object = &self.objects[which];
            let position = ray.origin + ray.direction * distance;
            let resting = position - object.velocity * time;
            let front = object.shape.normal(resting);
            let cosine = -front.dot(ray.direction);
            let normal = if cosine < 0.0 { -front } else { front };
            let bsdf = object.material.at(resting);
            match segment {
                0 => sample.first = Some(Hit { position, normal, albedo: bsdf.albedo() }),
                1 => sample.second = Some(Hit { position, normal, albedo: bsdf.albedo() }),
                _ => {}
            }
            let emission = object.material.emission;
            if cosine > 0.0 && emission != Vec3::ZERO {
                let share = drawn_density.map_or(1.0, |density: f64| {
                    density / (density + self.light_density(object.shape.area(), distance, cosine))
                });
                sample.color += throughput.times(emission) * share;
            }
            let frame = Frame::around(normal);
            let from = frame.local(-ray.direction);
            // Along the surface, rounding can put the direction below it; such a path carries no light worth saving.
            if segment + 1 == self.segments || !bsdf.reflects() || from.z <= 1e-12 {
                return;
            }
            let dimension = FIRST_SEGMENT + 2 * segment;
            sample.color += throughput.times(self.direct(position, &frame, &bsdf, from, time, numbers.pair(dimension)));
            let Some(to) = bsdf.sample(from, numbers.pair(dimension + 1)) else { return };
            let (value, density) = bsdf.evaluate(from, to);
            // The density of a direction along the surface may round to 0; its light would, too.
            if density <= 0.0 {
                return;
            }
            throughput = throughput.times(value * (1.0 / density));
            drawn_density = Some(density);
            ray = Ray { origin: position, direction: frame.world(to).normalized() };
        }
    }

    /// Light that reaches a point straight from a point drawn on one of the lights, and is reflected along `from`.
    fn direct(&self, at: Vec3, frame: &Frame, bsdf: &Bsdf, from: Vec3, time: f64, [a, b]: [f64; 2]) -> Vec3 {
        // The first number also chooses the light, and what is left of it is used again.
        let scaled = a * self.lights.len() as f64;
        let Some(&which) = self.lights.get(scaled as usize) else { return Vec3::ZERO };
        let light = &self.objects[which];
        let Some((point, front)) = light.shape.sample([scaled - scaled.floor(), b]) else { return Vec3::ZERO };
        let way = point + light.velocity * time - at;
        let distance = way.length();
        let direction = way * (1.0 / distance);
        let (to, cosine) = (frame.local(direction), -front.dot(direction));
        if !(to.z > 0.0 && cosine > 0.0 && distance > NEAREST) {
            return Vec3::ZERO;
        }
        let (value, density) = bsdf.evaluate(from, to);
        if value == Vec3::ZERO || self.blocked(&Ray { origin: at, direction }, distance - NEAREST, time) {
            return Vec3::ZERO;
        }
        // value / light density, times the balance heuristic's light density / (light density + density).
        let light_density = self.light_density(light.shape.area(), distance, cosine);
        value.times(light.material.emission) * (1.0 / (light_density + density))
    }

    /// Density per steradian with which a light's point is drawn; 0 for what cannot be drawn.
    fn light_density(&self, area: f64, distance: f64, cosine: f64) -> f64 {
        if area > 0.0 { distance * distance / (cosine * area * self.lights.len() as f64) } else { 0.0 }
    }

    /// The nearest object on a ray, and the distance to it.
    fn nearest(&self, ray: &Ray, time: f64) -> Option<(usize, f64)> {
        let mut found = None;
        let mut farthest = f64::INFINITY;
        for (which, object) in self.objects.iter().enumerate() {
            let moved = Ray { origin: ray.origin - object.velocity * time, ..*ray };
            if let Some(distance) = object.shape.intersect(&moved, farthest) {
                farthest = distance;
                found = Some((which, distance));
            }
        }
        found
    }

    /// Whether anything lies on a ray nearer than `farthest`.
    fn blocked(&self, ray: &Ray, farthest: f64, time: f64) -> bool {
        self.objects.iter().any(|object| {
            let moved = Ray { origin: ray.origin - object.velocity * time, ..*ray };
            object.shape.intersect(&moved, farthest).is_some()
        })
    }
}
