//! Step 4: from dependencies to the weights of the bilateral filter (eq. 5).

/// Sums of mutual information over a neighbourhood, in nats.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Dependencies {
    /// D_ck^r: of each colour channel on all random parameters.
    pub(crate) color_random: [f64; 3],
    /// D_ck^p: of each colour channel on the film position.
    pub(crate) color_position: [f64; 3],
    /// D_ck^fl: of each colour channel on each feature.
    pub(crate) color_features: [Vec<f64>; 3],
    /// D_c^fk: of all colour channels together on each feature.
    pub(crate) color_feature: Vec<f64>,
    /// D_fk^r: of each feature on all random parameters.
    pub(crate) feature_random: Vec<f64>,
    /// D_fk^p: of each feature on the film position.
    pub(crate) feature_position: Vec<f64>,
}

impl Dependencies {
    /// All 0, for so many features.
    pub(crate) fn new(features: usize) -> Self {
        Self {
            color_random: [0.0; 3],
            color_position: [0.0; 3],
            color_features: std::array::from_fn(|_| vec![0.0; features]),
            color_feature: vec![0.0; features],
            feature_random: vec![0.0; features],
            feature_position: vec![0.0; features],
        }
    }

    /// Adds up the colour channels' dependencies on each feature.
    pub(crate) fn add_colors(&mut self) {
        let [red, green, blue] = &self.color_features;
        for (((sum, red), green), blue) in self.color_feature.iter_mut().zip(red).zip(green).zip(blue) {
            *sum = red + green + blue;
        }
    }
}

/// What differences count in the bilateral filter.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Weights {
    /// alpha_k: of each colour channel, 0 to 1.
    pub(crate) color: [f32; 3],
    /// beta_k: of each feature, 0 to 1.
    pub(crate) features: Vec<f32>,
    /// (1 - W_c^r)^2: how little the colour depends on the random parameters, 0 to 1.
    pub(crate) confidence: f32,
}

impl Weights {
    /// All 0, for so many features.
    pub(crate) fn new(features: usize) -> Self {
        Self { color: [0.0; 3], features: vec![0.0; features], confidence: 0.0 }
    }

    /// The weights of iteration `t`. A quotient with denominator 0 is 0.
    pub(crate) fn set(&mut self, dependencies: &Dependencies, t: usize) {
        let Dependencies { color_random, color_position, color_feature, feature_random, feature_position, .. } =
            dependencies;
        let share = |part: f64, whole: f64| if whole == 0.0 { 0.0 } else { part / whole };
        let growth = 1.0 + 0.1 * t as f64;
        let mut color_on_random = 0.0;
        for (weight, (r, p)) in self.color.iter_mut().zip(color_random.iter().zip(color_position)) {
            let on_random = share(*r, r + p);
            *weight = (1.0 - 2.0 * growth * on_random).max(0.0) as f32;
            color_on_random += on_random / 3.0;
        }
        self.confidence = ((1.0 - color_on_random) * (1.0 - color_on_random)) as f32;
        let whole: f64 =
            color_random.iter().sum::<f64>() + color_position.iter().sum::<f64>() + color_feature.iter().sum::<f64>();
        let features = color_feature.iter().zip(feature_random).zip(feature_position);
        for (weight, ((on_color, r), p)) in self.features.iter_mut().zip(features) {
            let on_random = share(*r, r + p);
            *weight = (share(*on_color, whole) * (1.0 - growth * on_random).max(0.0)) as f32;
        }
    }
}

/// g = (1 - W_c^r)^2 / sigma^2 with sigma^2 = 8 sigma8_squared / s for a pixel with `samples` samples (eq. 6).
pub(crate) fn steepness(confidence: f32, sigma8_squared: f64, samples: usize) -> f64 {
    f64::from(confidence) * samples as f64 / (8.0 * sigma8_squared)
}
