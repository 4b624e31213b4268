//! How surfaces reflect: a mixture of a Lambertian and a rough metallic lobe (GGX).
//!
//! The GGX distribution with Smith's height-correlated masking is Walter et al., *Microfacet Models for Refraction*,
//! EGSR 2007, and Heitz, *Understanding the Masking-Shadowing Function*, JCGT 3(2), 2014; normals are drawn from those
//! visible, by Dupuy and Benyoub, *Sampling Visible GGX Normals with Spherical Caps*, HPG 2023; reflectance at grazing
//! angles is Schlick's. Only single scattering: a rough metal loses some energy, and nothing gains any.
//!
//! Directions here are local: unit vectors away from the surface, z along its normal.

use super::texture::Texture;
use super::vector::{Vec3, vec3};
use std::f64::consts::PI;

/// A surface's look.
#[derive(Clone, Copy, Debug)]
pub(super) struct Material {
    /// Reflectance of the Lambertian lobe.
    pub(super) diffuse: Texture,
    /// Share of the GGX lobe, 0..=1; the Lambertian one has the rest.
    pub(super) gloss: f64,
    /// Roughness of the GGX lobe, the alpha of the sources, above 0.
    pub(super) roughness: f64,
    /// Reflectance of the GGX lobe at normal incidence.
    pub(super) specular: Vec3,
    /// Radiance given off at the front.
    pub(super) emission: Vec3,
}

/// A material at one point of a surface.
#[derive(Clone, Copy)]
pub(super) struct Bsdf {
    diffuse: Vec3,
    gloss: f64,
    roughness: f64,
    specular: Vec3,
}

impl Material {
    /// Reflects evenly into all directions.
    pub(super) fn matte(diffuse: Texture) -> Self {
        Self { diffuse, gloss: 0.0, roughness: 1.0, specular: Vec3::ZERO, emission: Vec3::ZERO }
    }

    /// Rough metal.
    pub(super) fn metal(specular: Vec3, roughness: f64) -> Self {
        Self { gloss: 1.0, roughness, specular, ..Self::matte(Texture::Solid(Vec3::ZERO)) }
    }

    /// Gives off light and reflects none.
    pub(super) fn light(emission: Vec3) -> Self {
        Self { emission, ..Self::matte(Texture::Solid(Vec3::ZERO)) }
    }

    /// The material at a point of the surface at rest.
    pub(super) fn at(&self, point: Vec3) -> Bsdf {
        let Self { gloss, roughness, specular, .. } = *self;
        let diffuse = if gloss < 1.0 { self.diffuse.at(point) } else { Vec3::ZERO };
        Bsdf { diffuse, gloss, roughness, specular }
    }
}

impl Bsdf {
    /// What is written to a tile as albedo: the lobes' reflectances by their shares.
    pub(super) fn albedo(&self) -> Vec3 {
        self.diffuse * (1.0 - self.gloss) + self.specular * self.gloss
    }

    /// Whether any light is reflected.
    pub(super) fn reflects(&self) -> bool {
        self.albedo() != Vec3::ZERO
    }

    /// The BSDF times the cosine of `to`, and the density per steradian with which [`Bsdf::sample`] draws `to`. Both
    /// directions are above the surface.
    pub(super) fn evaluate(&self, from: Vec3, to: Vec3) -> (Vec3, f64) {
        let lambert = to.z / PI * (1.0 - self.gloss);
        if self.gloss == 0.0 {
            return (self.diffuse * lambert, lambert);
        }
        let square = self.roughness * self.roughness;
        let half = (from + to).normalized();
        let shape = half.z * half.z * (square - 1.0) + 1.0;
        let distribution = square / (PI * shape * shape);
        let masking = |w: Vec3| 0.5 * ((1.0 + square * (1.0 - w.z * w.z) / (w.z * w.z)).sqrt() - 1.0);
        let (mask_from, mask_to) = (masking(from), masking(to));
        let common = self.gloss * distribution / (4.0 * from.z);
        let one_minus = 1.0 - from.dot(half).min(1.0);
        let fifth = one_minus * one_minus * one_minus * one_minus * one_minus;
        let fresnel = self.specular + (Vec3::ONE - self.specular) * fifth;
        let value = self.diffuse * lambert + fresnel * (common / (1.0 + mask_from + mask_to));
        (value, lambert + common / (1.0 + mask_from))
    }

    /// Draws a direction; none when the light is absorbed, which happens to some of the GGX lobe.
    ///
    /// The first number also chooses the lobe, and what is left of it is used again.
    pub(super) fn sample(&self, from: Vec3, [a, b]: [f64; 2]) -> Option<Vec3> {
        let (sine, cosine) = libm::sincos(2.0 * PI * b);
        if a >= self.gloss {
            let a = (a - self.gloss) / (1.0 - self.gloss);
            let radius = a.sqrt();
            return Some(vec3(radius * cosine, radius * sine, (1.0 - a).sqrt()));
        }
        let a = a / self.gloss;
        let stretched = vec3(self.roughness * from.x, self.roughness * from.y, from.z).normalized();
        let z = (1.0 - a) * (1.0 + stretched.z) - stretched.z;
        let ring = (1.0 - z * z).max(0.0).sqrt();
        let half = vec3(ring * cosine, ring * sine, z) + stretched;
        let normal = vec3(self.roughness * half.x, self.roughness * half.y, half.z).normalized();
        let to = normal * (2.0 * from.dot(normal)) - from;
        (to.z > 0.0).then_some(to)
    }
}

#[cfg(test)]
mod tests {
    use super::super::random::{Numbers, Stream, pixel_key};
    use super::*;

    fn materials() -> [Bsdf; 4] {
        let gray = Texture::Solid(vec3(0.5, 0.6, 0.7));
        let mixed = Material { gloss: 0.4, ..Material::metal(vec3(0.9, 0.7, 0.5), 0.2) };
        [
            Material::matte(gray),
            Material::metal(Vec3::ONE, 0.5),
            Material::metal(vec3(0.9, 0.7, 0.5), 0.15),
            Material { diffuse: gray, ..mixed },
        ]
        .map(|m| m.at(Vec3::ZERO))
    }

    /// Reflected energy under uniform light, by drawing from the BSDF and by drawing evenly from the hemisphere, agree
    /// within four standard errors of the two, and never exceed 1; the density integrates to at most 1.
    #[test]
    fn sampling_matches_evaluation() {
        for (which, bsdf) in materials().into_iter().enumerate() {
            for (angle, from) in [vec3(0.0, 0.0, 1.0), vec3(0.6, 0.0, 0.8), vec3(0.3, 0.9, 0.2)].into_iter().enumerate()
            {
                let from = from.normalized();
                let count = 200_000;
                let mut sums = [[0.0; 2]; 3];
                for i in 0..count {
                    let numbers = Numbers::new(pixel_key(3, Stream::Samples, which as u32, angle as u32), i);
                    let weight = bsdf.sample(from, numbers.pair(0)).map_or(0.0, |to| {
                        let (value, density) = bsdf.evaluate(from, to);
                        assert!((to.length() - 1.0).abs() < 1e-9);
                        assert!(value.y <= density * 1.000_001, "a path gains energy: {value:?} / {density}");
                        value.y / density
                    });
                    let [a, b] = numbers.pair(1);
                    let (sine, cosine) = libm::sincos(2.0 * PI * b);
                    let (z, ring) = (1.0 - a, (1.0 - (1.0 - a) * (1.0 - a)).sqrt());
                    let (value, density) = bsdf.evaluate(from, vec3(ring * cosine, ring * sine, z));
                    for (sum, x) in sums.iter_mut().zip([weight, value.y * 2.0 * PI, density * 2.0 * PI]) {
                        *sum = [sum[0] + x, sum[1] + x * x];
                    }
                }
                let n = f64::from(count);
                let [drawn, even, total] = sums.map(|[s, q]| (s / n, (q / n - (s / n) * (s / n)).max(0.0) / n));
                let error = (drawn.1 + even.1).sqrt();
                assert!((drawn.0 - even.0).abs() < 4.0 * error + 1e-9, "{which} {angle}: {drawn:?} {even:?}");
                assert!(total.0 < 1.0 + 4.0 * total.1.sqrt() + 1e-9, "{which} {angle}: density {total:?}");
            }
        }
    }
}
