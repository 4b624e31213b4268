//! Step 6: samples far from their pixel's mean are set to it, and what the mean lost is given back to all of the
//! pixel's samples, so that the step keeps the energy (report, section 2.5).

/// A sample further from the mean than this many deviations is a spike.
const DEVIATIONS: f64 = 1.0 + 1e-4;

/// Tames the spikes of one pixel's samples (R, G, B next to each other), each channel by itself; nothing happens to
/// pixels of fewer than 3 samples. Returns how many values were set to the mean.
pub(crate) fn tame(samples: &mut [f32]) -> u64 {
    let count = samples.len() / 3;
    if count < 3 {
        return 0;
    }
    let mut spikes = 0;
    for channel in 0..3 {
        let values = || samples[channel..].iter().step_by(3).map(|&v| f64::from(v));
        let mean = values().sum::<f64>() / count as f64;
        let variance = values().map(|v| (v - mean) * (v - mean)).sum::<f64>() / count as f64;
        let limit = DEVIATIONS * variance.sqrt();
        let far = |v: f32| (f64::from(v) - mean).abs() > limit;
        let (mut found, mut excess) = (0, 0.0);
        for value in values().filter(|v| (v - mean).abs() > limit) {
            found += 1;
            excess += value - mean;
        }
        if found == 0 {
            continue;
        }
        let share = excess / count as f64;
        for value in samples[channel..].iter_mut().step_by(3) {
            let kept = if far(*value) { mean } else { f64::from(*value) };
            *value = (kept + share).max(f64::from(f32::MIN)).min(f64::from(f32::MAX)) as f32;
        }
        spikes += found;
    }
    spikes
}

#[cfg(test)]
mod tests {
    use super::tame;

    fn mean(samples: &[f32], channel: usize) -> f64 {
        samples[channel..].iter().step_by(3).map(|&v| f64::from(v)).sum::<f64>() * 3.0 / samples.len() as f64
    }

    #[test]
    fn keeps_the_energy_and_takes_the_spike_down() {
        let mut samples: Vec<f32> = (0..24).map(|i| 0.3 + 0.01 * i as f32).collect();
        samples[9] = 900.0;
        let before: [f64; 3] = std::array::from_fn(|k| mean(&samples, k));
        let spikes = tame(&mut samples);
        assert!(spikes >= 1);
        assert!(samples[9] < 300.0, "{}", samples[9]);
        for (k, before) in before.into_iter().enumerate() {
            assert!((mean(&samples, k) - before).abs() < 1e-6 * before, "channel {k}");
        }
    }

    #[test]
    fn leaves_what_has_none() {
        for mut samples in [vec![0.7f32; 24], vec![1.0, 2.0, 3.0, 9.0, 8.0, 7.0], vec![]] {
            let before = samples.clone();
            assert_eq!(tame(&mut samples), 0);
            assert_eq!(samples, before);
        }
    }

    #[test]
    fn greatest_values_stay_finite() {
        let mut samples = [f32::MAX, f32::MIN, 0.0].repeat(4);
        samples[0] = -f32::MAX;
        tame(&mut samples);
        assert!(samples.iter().all(|v| v.is_finite()));
    }
}
