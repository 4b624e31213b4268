//! Three `f64`: a point, a direction, or a linear RGB colour.

use std::ops::{Add, AddAssign, Mul, Neg, Sub};

/// A point or direction in world space (y is up), or a colour.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Vec3 {
    pub(super) x: f64,
    pub(super) y: f64,
    pub(super) z: f64,
}

/// The vector (x, y, z).
pub(super) const fn vec3(x: f64, y: f64, z: f64) -> Vec3 {
    Vec3 { x, y, z }
}

impl Vec3 {
    pub(super) const ZERO: Self = vec3(0.0, 0.0, 0.0);
    pub(super) const ONE: Self = vec3(1.0, 1.0, 1.0);

    pub(super) fn dot(self, other: Self) -> f64 {
        self.x * other.x + self.y * other.y + self.z * other.z
    }

    pub(super) fn cross(self, other: Self) -> Self {
        vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )
    }

    pub(super) fn length(self) -> f64 {
        self.dot(self).sqrt()
    }

    pub(super) fn normalized(self) -> Self {
        self * (1.0 / self.length())
    }

    /// Component by component, as for colours.
    pub(super) fn times(self, other: Self) -> Self {
        vec3(self.x * other.x, self.y * other.y, self.z * other.z)
    }

    pub(super) fn to_f32(self) -> [f32; 3] {
        [self.x as f32, self.y as f32, self.z as f32]
    }
}

impl Add for Vec3 {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        vec3(self.x + other.x, self.y + other.y, self.z + other.z)
    }
}

impl AddAssign for Vec3 {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl Sub for Vec3 {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        vec3(self.x - other.x, self.y - other.y, self.z - other.z)
    }
}

impl Mul<f64> for Vec3 {
    type Output = Self;
    fn mul(self, scale: f64) -> Self {
        vec3(self.x * scale, self.y * scale, self.z * scale)
    }
}

impl Neg for Vec3 {
    type Output = Self;
    fn neg(self) -> Self {
        self * -1.0
    }
}

/// Three axes at right angles, `z` being the one it was made from.
///
/// Duff et al., *Building an Orthonormal Basis, Revisited*, JCGT 6(1), 2017.
#[derive(Clone, Copy)]
pub(super) struct Frame {
    x: Vec3,
    y: Vec3,
    z: Vec3,
}

impl Frame {
    /// A frame around a unit vector.
    pub(super) fn around(z: Vec3) -> Self {
        let sign = if z.z < 0.0 { -1.0 } else { 1.0 };
        let a = -1.0 / (sign + z.z);
        let b = z.x * z.y * a;
        Self { x: vec3(1.0 + sign * z.x * z.x * a, sign * b, -sign * z.x), y: vec3(b, sign + z.y * z.y * a, -z.y), z }
    }

    /// World to local.
    pub(super) fn local(&self, v: Vec3) -> Vec3 {
        vec3(v.dot(self.x), v.dot(self.y), v.dot(self.z))
    }

    /// Local to world.
    pub(super) fn world(&self, v: Vec3) -> Vec3 {
        self.x * v.x + self.y * v.y + self.z * v.z
    }
}
