//! The scenes, all made of code.

use super::camera::Camera;
use super::material::Material;
use super::shape::Shape;
use super::texture::Texture;
use super::vector::{Vec3, vec3};

/// Something in a scene.
#[derive(Clone, Debug)]
pub(super) struct Object {
    pub(super) shape: Shape,
    pub(super) material: Material,
    /// Way that it moves while the shutter is open, from time 0 to 1, in scene units.
    pub(super) velocity: Vec3,
}

/// A scene that tiles can be rendered from. [`scenes`] lists them.
#[derive(Clone, Debug)]
pub struct Scene {
    pub(super) camera: Camera,
    pub(super) objects: Vec<Object>,
    /// The objects that give off light and that points can be drawn on.
    pub(super) lights: Vec<usize>,
    /// Radiance of whatever lies behind all objects.
    pub(super) sky: Vec3,
    /// Greatest number of segments of a path, counted from the camera.
    pub(super) segments: u32,
    /// Whether second hits are written to tiles.
    pub(super) second_hits: bool,
}

/// Names of the scenes, and what each shows.
pub const fn scenes() -> &'static [(&'static str, &'static str)] {
    &[
        ("lens", "depth of field: spheres near and far, small bright lights out of focus; no motion"),
        ("motion", "motion blur: textured spheres and a box in motion; no lens"),
        ("area-light", "a room lit by a small ceiling light: soft shadows, interreflection; no lens, no motion"),
        ("glossy", "rough metals lit by a large and a small light: highlights and outliers; no lens, no motion"),
        ("textures", "fine reflectance detail on everything; no lens, no motion"),
        ("all", "lens, motion, area lights, glossy and textured surfaces together: every plane varies"),
        ("plain", "matte spheres under one light; no lens, no motion, and no second hits recorded"),
    ]
}

impl Scene {
    /// The scene of this name.
    pub fn by_name(name: &str) -> Option<Self> {
        Some(match name {
            "lens" => lens(),
            "motion" => motion(),
            "area-light" => area_light(),
            "glossy" => glossy(),
            "textures" => textures(),
            "all" => all(),
            "plain" => plain(),
            _ => return None,
        })
    }

    /// An empty scene under a sky, with paths of at most `segments` segments.
    pub(super) fn new(camera: Camera, sky: Vec3, segments: u32) -> Self {
        Self { camera, objects: Vec::new(), lights: Vec::new(), sky, segments, second_hits: true }
    }

    /// With one more object, at rest.
    pub(super) fn with(self, shape: Shape, material: Material) -> Self {
        self.with_moving(shape, material, Vec3::ZERO)
    }

    /// With one more object.
    pub(super) fn with_moving(mut self, shape: Shape, material: Material, velocity: Vec3) -> Self {
        if material.emission != Vec3::ZERO && shape.area() > 0.0 {
            self.lights.push(self.objects.len());
        }
        self.objects.push(Object { shape, material, velocity });
        self
    }

    /// Whether anything moves.
    pub(super) fn moves(&self) -> bool {
        self.objects.iter().any(|object| object.velocity != Vec3::ZERO)
    }
}

const WHITE: Vec3 = vec3(0.75, 0.73, 0.7);
const DARK: Vec3 = vec3(0.08, 0.09, 0.12);
const RED: Vec3 = vec3(0.63, 0.1, 0.06);
const GREEN: Vec3 = vec3(0.14, 0.45, 0.09);
const BLUE: Vec3 = vec3(0.12, 0.2, 0.6);
const GOLD: Vec3 = vec3(1.0, 0.77, 0.34);
const SILVER: Vec3 = vec3(0.95, 0.93, 0.88);

/// Finite, so that positions stay within some ten units, as they do in real scenes.
fn floor() -> Shape {
    Shape::rectangle(vec3(-12.0, 0.0, -12.0), vec3(0.0, 0.0, 24.0), vec3(24.0, 0.0, 0.0))
}

fn matte(color: Vec3) -> Material {
    Material::matte(Texture::Solid(color))
}

fn light(radiance: f64) -> Material {
    Material::light(vec3(radiance, radiance * 0.9, radiance * 0.75))
}

fn sphere(x: f64, y: f64, z: f64, radius: f64) -> Shape {
    Shape::Sphere { center: vec3(x, y, z), radius }
}

fn block(low: Vec3, high: Vec3) -> Shape {
    Shape::Block { low, high }
}

/// A horizontal rectangle around (x, z) that faces down.
fn ceiling(x: f64, y: f64, z: f64, width: f64, depth: f64) -> Shape {
    Shape::rectangle(vec3(x - width * 0.5, y, z - depth * 0.5), vec3(width, 0.0, 0.0), vec3(0.0, 0.0, depth))
}

fn checker() -> Material {
    Material::matte(Texture::Checker { scale: 2.0, colors: [WHITE, DARK] })
}

fn marble(scale: f64) -> Material {
    Material::matte(Texture::Noise { scale, colors: [DARK, WHITE] })
}

fn stripes() -> Material {
    Material::matte(Texture::Stripes { scale: 6.0, colors: [WHITE, BLUE] })
}

/// A varnish: some of a metal's lobe over a texture.
fn varnished(below: Material, gloss: f64, roughness: f64) -> Material {
    Material { gloss, roughness, specular: vec3(0.6, 0.6, 0.6), ..below }
}

fn lens() -> Scene {
    let camera = Camera::new(vec3(0.0, 1.3, 6.0), vec3(0.0, 0.9, 0.0), 36.0).with_lens(0.18, 6.0);
    let mut scene = Scene::new(camera, vec3(0.12, 0.16, 0.24), 4)
        .with(floor(), checker())
        .with(ceiling(-1.0, 5.0, 1.0, 2.5, 2.5), light(7.0))
        .with(sphere(0.0, 0.8, 0.0, 0.8), stripes())
        .with(sphere(-1.5, 0.5, -3.5, 0.5), matte(RED))
        .with(sphere(1.7, 0.6, -5.0, 0.6), matte(GREEN))
        .with(sphere(0.75, 0.3, 2.6, 0.3), matte(BLUE))
        .with(block(vec3(-1.6, 0.0, 1.3), vec3(-1.0, 0.6, 1.9)), marble(5.0));
    for (x, y, z) in [(-3.0, 2.6, -8.0), (-0.5, 3.4, -9.0), (2.6, 2.7, -7.0)] {
        scene = scene.with(sphere(x, y, z, 0.07), light(400.0));
    }
    scene
}

fn motion() -> Scene {
    let camera = Camera::new(vec3(0.0, 1.6, 6.0), vec3(0.0, 0.8, 0.0), 36.0);
    Scene::new(camera, vec3(0.25, 0.28, 0.34), 4)
        .with(
            floor(),
            Material::matte(Texture::Tiles { scale: 1.5, line: 0.06, colors: [vec3(0.35, 0.45, 0.5), WHITE] }),
        )
        .with(ceiling(0.5, 5.0, 1.5, 2.0, 2.0), light(9.0))
        .with_moving(sphere(-1.6, 0.7, 0.0, 0.7), stripes(), vec3(1.1, 0.3, 0.0))
        .with_moving(sphere(1.3, 0.5, 1.2, 0.5), matte(RED), vec3(0.0, 0.9, -0.4))
        .with_moving(block(vec3(0.2, 0.0, -2.2), vec3(1.2, 1.4, -1.2)), marble(3.0), vec3(0.7, 0.0, 0.5))
}

fn area_light() -> Scene {
    let camera = Camera::new(vec3(0.0, 1.0, 3.9), vec3(0.0, 1.0, 0.0), 39.0);
    let (across, up, deep) = (vec3(2.0, 0.0, 0.0), vec3(0.0, 2.0, 0.0), vec3(0.0, 0.0, 2.0));
    let corner = vec3(-1.0, 0.0, -1.0);
    Scene::new(camera, Vec3::ZERO, 5)
        .with(Shape::rectangle(corner, deep, across), matte(WHITE))
        .with(Shape::rectangle(corner + up, across, deep), matte(WHITE))
        .with(Shape::rectangle(corner, across, up), matte(WHITE))
        .with(Shape::rectangle(corner, up, deep), matte(RED))
        .with(Shape::rectangle(corner + across, deep, up), matte(GREEN))
        .with(ceiling(0.0, 1.98, 0.0, 0.5, 0.4), light(17.0))
        .with(block(vec3(-0.65, 0.0, -0.65), vec3(-0.1, 1.15, -0.1)), matte(WHITE))
        .with(sphere(0.42, 0.35, 0.25, 0.35), matte(WHITE))
}

fn glossy() -> Scene {
    let camera = Camera::new(vec3(0.0, 1.9, 6.0), vec3(0.0, 0.7, 0.0), 36.0);
    let mut scene = Scene::new(camera, vec3(0.05, 0.06, 0.08), 5)
        .with(floor(), varnished(matte(vec3(0.25, 0.27, 0.3)), 0.3, 0.3))
        .with(ceiling(-2.0, 4.5, -1.0, 2.5, 2.0), light(6.0))
        .with(sphere(1.6, 3.2, 0.5, 0.12), light(120.0))
        .with(block(vec3(-2.5, 0.0, -2.4), vec3(2.5, 1.2, -2.0)), varnished(matte(RED), 0.4, 0.2));
    for (k, roughness) in [0.12, 0.25, 0.45].into_iter().enumerate() {
        let metal = [GOLD, SILVER, vec3(0.95, 0.64, 0.54)][k];
        scene = scene.with(sphere(k as f64 * 1.5 - 1.5, 0.65, 0.0, 0.65), Material::metal(metal, roughness));
    }
    scene
}

fn textures() -> Scene {
    let camera = Camera::new(vec3(0.3, 1.5, 5.0), vec3(0.0, 0.8, 0.0), 36.0);
    Scene::new(camera, vec3(0.3, 0.32, 0.36), 4)
        .with(floor(), Material::matte(Texture::Tiles { scale: 3.0, line: 0.08, colors: [vec3(0.3, 0.4, 0.5), WHITE] }))
        .with(ceiling(1.0, 4.5, 2.0, 2.0, 2.0), light(8.0))
        .with(Shape::rectangle(vec3(-6.0, 0.0, -2.0), vec3(12.0, 0.0, 0.0), vec3(0.0, 6.0, 0.0)), stripes())
        .with(block(vec3(-1.35, 0.0, -0.8), vec3(0.0, 1.35, 0.5)), marble(8.0))
        .with(sphere(0.85, 0.7, 0.3, 0.7), Material::matte(Texture::Checker { scale: 9.0, colors: [GOLD, DARK] }))
}

fn all() -> Scene {
    let camera = Camera::new(vec3(0.2, 1.5, 6.0), vec3(0.0, 0.8, 0.0), 36.0).with_lens(0.1, 6.0);
    Scene::new(camera, vec3(0.2, 0.24, 0.3), 4)
        .with(floor(), varnished(checker(), 0.15, 0.2))
        .with(ceiling(-0.5, 4.5, 1.0, 2.0, 2.0), light(8.0))
        .with(sphere(2.4, 2.7, -5.0, 0.1), light(200.0))
        .with(sphere(0.0, 0.75, 0.0, 0.75), Material::metal(GOLD, 0.2))
        .with_moving(sphere(-1.7, 0.55, 0.6, 0.55), stripes(), vec3(0.5, 0.25, 0.0))
        .with_moving(sphere(1.5, 0.45, 1.2, 0.45), matte(RED), vec3(0.0, 0.6, 0.0))
        .with(block(vec3(0.9, 0.0, -2.6), vec3(2.1, 1.5, -1.4)), marble(4.0))
        .with(sphere(-1.9, 0.8, -3.5, 0.8), matte(GREEN))
}

fn plain() -> Scene {
    let camera = Camera::new(vec3(0.0, 1.6, 6.0), vec3(0.0, 0.7, 0.0), 36.0);
    let scene = Scene::new(camera, vec3(0.2, 0.24, 0.3), 4)
        .with(floor(), matte(vec3(0.5, 0.48, 0.45)))
        .with(ceiling(-1.5, 4.5, 1.0, 1.5, 1.5), light(12.0))
        .with(sphere(-1.5, 0.7, 0.0, 0.7), matte(RED))
        .with(sphere(0.0, 0.7, -0.5, 0.7), matte(GREEN))
        .with(sphere(1.5, 0.7, 0.0, 0.7), matte(BLUE))
        .with(block(vec3(-0.4, 0.0, 1.2), vec3(0.4, 0.5, 1.8)), matte(WHITE));
    Scene { second_hits: false, ..scene }
}
