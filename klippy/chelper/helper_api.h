#ifndef CHELPER_HELPER_API_H
#define CHELPER_HELPER_API_H
// What Python sees of the C helper: all that these headers and the ones they include declare.

#include "chelper/link/clockfit.h"
#include "chelper/link/msgblock.h"
#include "chelper/link/portthread.h"
#include "chelper/link/serialqueue.h"
#include "chelper/motion/filament_flow.h"
#include "chelper/motion/gcode_rows.h"
#include "chelper/motion/kinematics.h"
#include "chelper/motion/lookahead.h"
#include "chelper/plugin_names.h"
#include "chelper/motion/stepcompress.h"
#include "chelper/motion/steppersync.h"
#include "thermal/control/bridge.h"
#include "thermal/plan/path_pieces.h"
#include "thermal/sensing/pipeline.h"
#include "vibration/mount_band.h"

#endif
