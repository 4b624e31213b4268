//! What the JSON looks like that calls take and give, for the OpenAPI document. It is written elsewhere: a test compares
//! these descriptions with real answers.

use std::collections::BTreeMap;
use utoipa::ToSchema;

/// Describes the JSON of this module's calls.
macro_rules! schemas {
    ($($(#[$meta:meta])* struct $name:ident { $($(#[$field_meta:meta])* $field:ident: $type:ty,)+ })+) => { $(
        $(#[$meta])*
        #[derive(ToSchema)]
        #[expect(dead_code, reason = "it only describes")]
        pub(super) struct $name { $($(#[$field_meta])* $field: $type,)+ }
    )+ };
}

schemas! {
    /// What an image is to be. Every other key is a parameter of the preset.
    struct OpenImage {
        /// Width in pixels, 1 to 1048576.
        #[schema(minimum = 1, maximum = 1_048_576)]
        width: u32,
        /// Height in pixels, 1 to 1048576.
        #[schema(minimum = 1, maximum = 1_048_576)]
        height: u32,
        /// Chosen by the client; the service makes one if it is absent.
        #[schema(pattern = "^[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}$")]
        id: Option<String>,
        /// How to filter; `lean` if it is absent.
        preset: Option<String>,
        /// Keys every random draw; 0 if it is absent.
        seed: Option<u64>,
        /// Who brings the context around tiles: `client` (also if it is absent) with each tile, or `neighbors`, the tiles
        /// around it.
        halo: Option<String>,
        /// With `neighbors`: samples of each pixel; or `max_samples`.
        samples: Option<u32>,
        /// With `neighbors`: most samples of a pixel, if they vary.
        max_samples: Option<u32>,
        /// With `neighbors`: the channels of all tiles, in order.
        channels: Option<Vec<OpenChannel>>,
    }

    /// A channel as tiles announce it (proto/tile.md).
    struct OpenChannel {
        /// Its name.
        name: String,
        /// `film`, `color`, `feature` or `random`.
        role: String,
        /// Values of each sample.
        components: u32,
        /// Of a feature: `position` or `other`.
        #[schema(nullable = false)]
        space: Option<String>,
        /// Of a random parameter: whether it is uniform on [0, 1).
        #[schema(nullable = false)]
        uniform: Option<bool>,
    }

    /// All images.
    struct Images {
        /// By id.
        images: Vec<ListedImage>,
    }

    /// An image's summary; if it cannot be read, only what is known all the same.
    struct ListedImage {
        /// Its id.
        id: String,
        /// Width in pixels.
        #[schema(nullable = false)]
        width: Option<u32>,
        /// Height in pixels.
        #[schema(nullable = false)]
        height: Option<u32>,
        /// How it is filtered.
        #[schema(nullable = false)]
        preset: Option<String>,
        /// Keys every random draw.
        #[schema(nullable = false)]
        seed: Option<u64>,
        /// Every parameter of the preset, in words.
        #[schema(nullable = false)]
        parameters: Option<BTreeMap<String, String>>,
        /// `client` or `neighbors`: who brings the context around tiles.
        #[schema(nullable = false)]
        halo: Option<String>,
        /// Whether every pixel is filtered and stored.
        #[schema(nullable = false)]
        complete: Option<bool>,
        /// Whether it takes no more tiles.
        #[schema(nullable = false)]
        finished: Option<bool>,
        /// Tiles filtered and stored; with `neighbors` these are regions, or parts of them.
        #[schema(nullable = false)]
        tiles_done: Option<u64>,
        /// Pixels of the image.
        #[schema(nullable = false)]
        pixels: Option<u64>,
        /// Pixels filtered and stored.
        #[schema(nullable = false)]
        pixels_done: Option<u64>,
        /// Bytes of disk that are set aside for it.
        #[schema(nullable = false)]
        disk: Option<u64>,
        /// Seconds since 1970 at which it is forgotten, if nobody uses it until then.
        expires: u64,
        /// With `neighbors`: cores that have come.
        #[schema(nullable = false)]
        tiles_stored: Option<u64>,
        /// With `neighbors`: their pixels.
        #[schema(nullable = false)]
        pixels_stored: Option<u64>,
        /// With `neighbors`: regions in all.
        #[schema(nullable = false)]
        regions: Option<u64>,
        /// With `neighbors`: regions that are not filtered for good yet.
        #[schema(nullable = false)]
        regions_open: Option<u64>,
        /// Which file is damaged, if one is.
        #[schema(nullable = false)]
        damaged: Option<String>,
    }

    /// A region that is not filtered for good yet.
    struct WaitingRegion {
        /// The region: x, y, width, height.
        region: [u32; 4],
        /// `waiting`, `ready`, `running`, `too_large` for the memory there is, or `filtered` from pixels whose cores have
        /// not come.
        state: String,
        /// If it is `waiting`: what is missing of the pixels that it reads; if `filtered`, of their cores; the first 16.
        #[schema(nullable = false)]
        r#for: Option<Vec<[u32; 4]>>,
        /// The same: how many there are.
        #[schema(nullable = false)]
        for_regions: Option<u64>,
    }

    /// A tile that is stored.
    struct TileStatus {
        /// Its core: x, y, width, height.
        tile: [u32; 4],
        /// What happened.
        report: Report,
    }

    /// What happened to a tile.
    struct Report {
        /// Time that filtering took, in seconds.
        seconds: f64,
        /// Samples in the core.
        samples: u64,
        /// Values made finite, by role.
        replaced: Replaced,
        /// Colour values that the spike step set to their pixel's mean.
        spikes: u64,
        /// Sum of the core's pixel values, before.
        energy_in: f64,
        /// The same sum after.
        energy_out: f64,
        /// Energy out over energy in; null for a core that was black.
        energy_ratio: Option<f64>,
        /// Pixels without samples that got their neighbours' mean.
        filled: u64,
        /// Pixels without samples that stayed black.
        unfilled: u64,
        /// Pixels that were passed through, within the tolerance.
        settled: u64,
        /// Sum over these of the relMSE that filtering could have taken off at most, by estimate.
        settled_error: f64,
        /// The halo that it had: left, top, right, bottom, in pixels.
        halo: [u32; 4],
        /// The halo that it would need for the same bits as in the whole image.
        halo_needed: [u32; 4],
        /// Whether the halo was enough.
        exact: bool,
        /// Bytes of the planes that were not looked at, over the data window.
        left_out_bytes: u64,
        /// An estimate of the work; null if the method does not tell.
        work: Option<Work>,
    }

    /// An estimate of work, in steps: about the difference of two samples in one column.
    struct Work {
        /// Steps done.
        done: u64,
        /// Steps left out with whole planes.
        planes: u64,
        /// Steps left out for columns that are constant over a neighbourhood.
        columns: u64,
        /// Steps left out for differences that weigh nothing.
        distances: u64,
        /// The share that was left out, 0 to 1.
        saved: f64,
    }

    /// Values that were not finite and were replaced.
    struct Replaced {
        /// Of colours.
        color: u64,
        /// Of features, infinities only.
        feature: u64,
        /// Of random parameters.
        random: u64,
        /// Of film positions.
        film: u64,
    }

    /// Sums of the reports of an image's tiles.
    struct Totals {
        /// Time that filtering took, in seconds.
        seconds: f64,
        /// Tiles.
        tiles: u64,
        /// Pixels.
        pixels: u64,
        /// Samples.
        samples: u64,
        /// Values made finite, by role.
        replaced: Replaced,
        /// Colour values that the spike step set to their pixel's mean.
        spikes: u64,
        /// Sum of the pixel values, before.
        energy_in: f64,
        /// The same sum after.
        energy_out: f64,
        /// Pixels without samples that got their neighbours' mean.
        filled: u64,
        /// Pixels without samples that stayed black.
        unfilled: u64,
        /// Pixels that were passed through, within the tolerance.
        settled: u64,
        /// Sum over these of the relMSE that filtering could have taken off at most, by estimate.
        settled_error: f64,
        /// Tiles whose halo was not enough.
        short_of_halo: u64,
        /// The widest halo needed on each side.
        halo_needed: [u32; 4],
        /// Planes that the method did not look at.
        left_out: Vec<LeftOut>,
        /// Bytes of the planes that were not looked at, over the data window.
        left_out_bytes: u64,
        /// An estimate of the work; null if the method does not tell.
        work: Option<Work>,
    }

    /// A plane that tiles did without.
    struct LeftOut {
        /// The plane.
        plane: String,
        /// `constant`, `missing`, `unused` or `equal`.
        reason: String,
        /// How many tiles.
        tiles: u64,
    }

    /// A line of the answer to tiles. What is not said of a state is absent.
    struct TileLine {
        /// `filtered`, `stored`, `repeated`, `error` or `end`; skip what you do not know.
        state: String,
        /// Its core: x, y, width, height; null if it is not known which tile it was.
        tile: Option<[u32; 4]>,
        /// With `error`: what is wrong.
        #[schema(nullable = false)]
        problem: Option<Problem>,
        /// With `end`: tiles filtered, stored or repeated, as a number.
        #[schema(nullable = false)]
        tiles: Option<u64>,
        /// With `end`: tiles refused.
        #[schema(nullable = false)]
        errors: Option<u64>,
    }

    /// What is wrong (RFC 9457). Further members by code: see proto/http.md.
    struct Problem {
        /// `urn:rpfd:problem:` and the code.
        r#type: String,
        /// The kind of problem in words.
        title: String,
        /// The HTTP status.
        status: u16,
        /// What is wrong this time, where, and what would be right.
        detail: String,
        /// For programs to decide by.
        code: String,
        /// The request that it is about, as in the header X-Request-Id; absent within streams.
        #[schema(nullable = false)]
        request_id: Option<String>,
        /// Seconds after which the request is worth repeating.
        #[schema(nullable = false)]
        retry_after: Option<u64>,
    }
}

/// Describes JSON that has some members in common, which come first.
macro_rules! sharing {
    (@one { $($shared:tt)* } $(#[$meta:meta])* struct $name:ident { $($own:tt)* }) => {
        schemas! { $(#[$meta])* struct $name { $($shared)* $($own)* } }
    };
    ($shared:tt $($(#[$meta:meta])* struct $name:ident $own:tt)+) => {
        $(sharing!(@one $shared $(#[$meta])* struct $name $own);)+
    };
}

sharing! {
    {
        /// Its id.
        id: String,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// How it is filtered.
        preset: String,
        /// Keys every random draw.
        seed: u64,
        /// Every parameter of the preset, in words.
        parameters: BTreeMap<String, String>,
        /// `client` or `neighbors`: who brings the context around tiles.
        halo: String,
        /// Whether every pixel is filtered and stored.
        complete: bool,
        /// Whether it takes no more tiles.
        finished: bool,
        /// Tiles filtered and stored; with `neighbors` these are regions, or parts of them.
        tiles_done: u64,
        /// Pixels of the image.
        pixels: u64,
        /// Pixels filtered and stored.
        pixels_done: u64,
        /// Bytes of disk that are set aside for it.
        disk: u64,
        /// Seconds since 1970 at which it is forgotten, if nobody uses it until then.
        expires: u64,
        /// With `neighbors`: cores that have come.
        #[schema(nullable = false)]
        tiles_stored: Option<u64>,
        /// With `neighbors`: their pixels.
        #[schema(nullable = false)]
        pixels_stored: Option<u64>,
        /// With `neighbors`: regions in all.
        #[schema(nullable = false)]
        regions: Option<u64>,
        /// With `neighbors`: regions that are not filtered for good yet.
        #[schema(nullable = false)]
        regions_open: Option<u64>,

    }

    /// An image's summary.
    struct Image {}

    /// All about one image.
    struct ImageStatus {
    /// Regions that are not stored: x, y, width, height.
        missing: Vec<[u32; 4]>,
        /// The tiles stored, by rows.
        tiles: Vec<TileStatus>,
        /// Sums of the tiles' reports.
        totals: Totals,
        /// With `neighbors`: the regions that are not filtered for good, by rows.
        #[schema(nullable = false)]
        waiting: Option<Vec<WaitingRegion>>,
        /// With `neighbors`: what keeps regions from being filtered, until it is tried again.
        trouble: Option<Problem>,

    }
}
