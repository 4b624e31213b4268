//! What `filter::plan` says is never exceeded, and never more than a quarter too high: measured by counting every
//! allocation of the process. A test binary of its own, one test at a time, so that nothing else allocates meanwhile.

use peak_alloc::PeakAlloc;
use rpfd::filter::plan::{Shape, plan};
use rpfd::filter::{
    Channel, ChannelSet, Counts, Execution, Method, Plane, Rect, Role, SampleTile, TileGeometry, filter,
};

use std::sync::Mutex;

#[global_allocator]
static ALLOCATIONS: PeakAlloc = PeakAlloc;

/// Held by whichever test counts.
static COUNTING: Mutex<()> = Mutex::new(());

/// Channels with so many features and random parameters.
fn channels(features: u32, random: u32) -> ChannelSet {
    let mut channels = vec![Channel::new("film", Role::Film, 2), Channel::new("color", Role::Color, 3)];
    channels.extend((0..features).map(|i| Channel::new(format!("f{i}"), Role::Feature { position: i == 0 }, 3)));
    channels.extend((0..random).map(|i| Channel::new(format!("r{i}"), Role::Random { uniform: true }, 2)));
    ChannelSet::new(channels).expect("valid channels")
}

/// Samples that are all alive and all alike: nothing is left out or rejected, so neighbourhoods are as large as can be.
fn planes(channels: &ChannelSet, samples: usize) -> Vec<Plane> {
    let value = |plane: usize, i: usize| ((i * 2_654_435_761 + plane * 97) % 1009) as f32 * 1e-5;
    (0..channels.planes()).map(|p| Plane::Values((0..samples).map(|i| value(p, i)).collect())).collect()
}

/// Peak bytes while a tile is taken in and filtered, and what the plan says.
fn measure(
    geometry: TileGeometry,
    channels: ChannelSet,
    counts: Counts,
    method: &Method,
    threads: usize,
    leave_out: bool,
) -> (u64, u64) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
    pool.install(|| ());
    let pixels = geometry.window().area();
    let (samples, most, varying) = match &counts {
        Counts::Uniform(n) => (pixels * u64::from(*n), *n, false),
        Counts::Varying(counts) => {
            (counts.iter().map(|&n| u64::from(n)).sum(), counts.iter().copied().max().map_or(0, u32::from), true)
        }
    };
    let shape = Shape { geometry: &geometry, channels: &channels, samples, max_per_pixel: most, varying };
    let planned = plan(&shape, method).total(threads);
    // The counts come in by value: they are part of the plan, but there already.
    let given = if varying { pixels * 2 } else { 0 };
    let before = ALLOCATIONS.current_usage() as u64;
    ALLOCATIONS.reset_peak_usage();
    let planes = planes(&channels, samples as usize);
    let tile = SampleTile::new(geometry, channels.clone(), counts, planes).expect("a valid tile");
    let execution = Execution { pool: Some(&pool), leave_out, ..Execution::default() };
    let filtered = filter(&tile, method, &execution).expect("nobody stops it");
    assert_eq!(filtered.rgb[0].len() as u64, geometry.core().area());
    (ALLOCATIONS.peak_usage() as u64 - before + given, planned)
}

/// A tile of 27 planes that vary takes its samples once, and what the plan says for each thread; all else is at most three
/// tenths of the samples.
#[test]
fn a_tile_takes_its_samples_once_and_three_tenths_more() {
    let _alone = COUNTING.lock();
    let whole = Rect::new(0, 0, 96, 96);
    let geometry = TileGeometry::with_halo([96, 96], whole, 0).expect("a valid geometry");
    // Film 2, colour 3, features 15, random parameters 7 in pairs and one alone.
    let mut channels = channels(5, 3).channels().to_vec();
    channels.push(Channel::new("time", Role::Random { uniform: true }, 1));
    let channels = ChannelSet::new(channels).expect("valid channels");
    assert_eq!(channels.planes(), 27);
    for preset in ["lean", "paper-fast"] {
        let quick: &[_] = if preset == "lean" { &[] } else { &[("fractions", "0.002,0.004,0.03,0.05")] };
        let method = Method::with(preset, quick.iter().copied()).expect("valid");
        for threads in [1, 2] {
            let counts = Counts::Uniform(8);
            let shape = Shape {
                geometry: &geometry,
                channels: &channels,
                samples: whole.area() * 8,
                max_per_pixel: 8,
                varying: false,
            };
            let planned = plan(&shape, &method);
            let scratch = planned.per_thread * threads as u64;
            let (peak, _) = measure(geometry, channels.clone(), counts, &method, threads, true);
            let beside = peak - scratch - planned.samples;
            println!(
                "{preset} on {threads} threads: samples {}, scratch {scratch}, beside {beside} ({:.1} %)",
                planned.samples,
                100.0 * beside as f64 / planned.samples as f64
            );
            assert!(beside * 10 <= planned.samples * 3, "{preset}: {beside} bytes beside {}", planned.samples);
        }
    }
}

#[test]
fn plans_are_upper_bounds_and_tight() {
    let _alone = COUNTING.lock();
    let tile = |image: u32, core: u32, halo: u32| {
        let at = (image - core) / 2;
        TileGeometry::with_halo([image, image], Rect::new(at, at, core, core), halo).expect("a valid geometry")
    };
    let quick = [("fractions", "0.002,0.004,0.03,0.05")];
    let methods = [
        Method::preset("lean").expect("a preset"),
        Method::with("lean", [("tolerance", "0.5")]).expect("valid"),
        Method::preset("unfiltered").expect("a preset"),
        Method::with("gaussian", [("sigma", "5")]).expect("valid"),
        Method::with("bilateral", [("color_scale", "log")]).expect("valid"),
        Method::preset("cross-bilateral").expect("a preset"),
        Method::with("paper-fast", quick).expect("valid"),
        Method::with("lean", [("information_grid", "1"), ("bins", "31"), ("fractions", "1,1")]).expect("valid"),
    ];
    for method in &methods {
        for (geometry, channels, counts) in [
            (tile(64, 64, 0), channels(5, 3), Counts::Uniform(8)),
            (tile(128, 48, 17), channels(6, 4), Counts::Uniform(4)),
            (tile(96, 96, 0), channels(0, 0), Counts::Uniform(2)),
            (tile(72, 40, 16), channels(1, 1), Counts::Varying((0..72 * 72).map(|i| (i % 7) as u16).collect())),
        ] {
            for (threads, leave_out) in [(1, true), (3, true), (1, false)] {
                let planes = channels.planes();
                let (peak, planned) = measure(geometry, channels.clone(), counts.clone(), method, threads, leave_out);
                let name = format!("{} of {planes} planes on {threads} threads", method.preset_name());
                assert!(peak <= planned, "{name}: {peak} bytes where {planned} were planned");
                assert!(planned * 4 <= peak * 5, "{name}: {planned} bytes planned, {peak} needed");
            }
        }
    }
}

/// What is known of an image's tiles, cores and regions takes no more than it says, live and when it is opened again.
#[cfg(feature = "program")]
#[test]
fn what_is_known_of_an_image_is_no_more_than_is_said() {
    use rpfd::{
        disk::Directory,
        filter::geometry::tiling,
        image::{Announced, Description, Image, Outcome, disk_bytes},
    };
    use std::sync::Arc;

    const SIZE: [u32; 2] = [768, 512];
    let _alone = COUNTING.lock();
    let channels = channels(3, 2);
    let method = Method::preset("unfiltered").expect("a preset");
    let announced = |varying| Announced { channels: channels.clone(), samples: 1, varying, region: 16 };
    let tile = |core: Rect, halo: u32| {
        let geometry = TileGeometry::with_halo(SIZE, core, halo).expect("a valid geometry");
        let planes = planes(&channels, geometry.window().area() as usize);
        SampleTile::new(geometry, channels.clone(), Counts::Uniform(1), planes).expect("a valid tile")
    };
    let mut wrong = Vec::new();
    // Tiles by rows and from all over; cores with and without halos that are kept.
    for (neighbors, step) in [(None, 1), (None, 601), (Some(announced(false)), 1), (Some(announced(true)), 601)] {
        let folder = tempfile::tempdir().expect("a folder");
        // Regions that read their neighbours, so that halos are kept.
        let keeps = neighbors.is_some();
        let description = Description {
            size: SIZE,
            method: if keeps { Method::default() } else { method.clone() },
            seed: 0,
            leave_out: true,
            neighbors,
            owner: None,
            disk: 0,
        };
        let description = Description { disk: disk_bytes(&description), ..description };
        Image::create(&Directory::new(folder.path()), &description).expect("an image");
        let cores: Vec<Rect> = tiling(SIZE, 16).collect();
        let before = ALLOCATIONS.current_usage() as u64;
        let mut check = |image: &Image, used: u64, what: &str| {
            let said = image.read().index_bytes();
            if used > said || said > 4 * used {
                wrong.push(format!("{keeps}, {step}, {what}: {used} of {said} bytes"));
            }
        };
        let open = || Arc::new(Image::open(Box::new(Directory::new(folder.path()))).expect("an image"));
        let image = open();
        for i in 0..cores.len() {
            // Every fourth column, so that halos stay.
            let core = cores[i * step % cores.len()];
            if keeps && !(core.x / 16).is_multiple_of(4) {
                continue;
            }
            let tile = tile(core, if keeps { 5 } else { 0 });
            if let Outcome::Filter(claim) = image.offer(&tile, false).expect("a tile") {
                let filtered = filter(&tile, &method, &Execution::default()).expect("nobody stops it");
                image.add(claim, &filtered, 0.5).expect("a tile");
            }
            if i % 64 == 0 {
                image.flush().expect("no error");
            }
        }
        image.flush().expect("no error");
        check(&image, ALLOCATIONS.current_usage() as u64 - before, "as they came");
        image.close();
        drop(image);
        ALLOCATIONS.reset_peak_usage();
        let before = ALLOCATIONS.current_usage() as u64;
        let image = open();
        check(&image, ALLOCATIONS.peak_usage() as u64 - before, "opened again");
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
