//! Step 6: samples far from their pixel's mean are set to it, and what the mean lost is given back to all of the
//! pixel's samples, so that the step keeps the energy (report, section 2.5).

/// A sample further from the mean than this many deviations is a spike.
const DEVIATIONS: f64 = 1.0 + 1e-4;

/// Tames the spikes of one pixel's samples (R, G, B next to each other), each channel by itself; nothing happens to
/// pixels of fewer than 3 samples. Returns how many values were set to the mean.
pub(crate) fn tame(samples: &mut [f32]) -> u64 {
    let (samples, _) = samples.as_chunks_mut::<3>();
    if samples.len() < 3 {
        return 0;
    }
    // The three channels side by side: the sums of one do not wait for those of another.
    let count = samples.len() as f64;
    let (mut mean, mut limit) = ([-0.0; 3], [0.0; 3]);
    for sample in &*samples {
        for k in 0..3 {
            mean[k] += f64::from(sample[k]);
        }
    }
    mean = mean.map(|sum| sum / count);
    for sample in &*samples {
        for k in 0..3 {
            limit[k] += (f64::from(sample[k]) - mean[k]) * (f64::from(sample[k]) - mean[k]);
        }
    }
    limit = limit.map(|squares| DEVIATIONS * (squares / count).sqrt());
    let (mut found, mut excess) = ([0; 3], [0.0; 3]);
    for sample in &*samples {
        for k in 0..3 {
            let off = f64::from(sample[k]) - mean[k];
            let far = off.abs() > limit[k];
            found[k] += u64::from(far);
            excess[k] += if far { off } else { 0.0 };
        }
    }
    for k in (0..3).filter(|&k| found[k] > 0) {
        let share = excess[k] / count;
        for value in samples.iter_mut().map(|sample| &mut sample[k]) {
            let own = f64::from(*value);
            let kept = if (own - mean[k]).abs() > limit[k] { mean[k] } else { own };
            *value = (kept + share).max(f64::from(f32::MIN)).min(f64::from(f32::MAX)) as f32;
        }
    }
    found.iter().sum()
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
