/* A lag that does what it should. */
#include "lag.h"

const Behaviour behaviour = {.state_size = sizeof(Lag), LAG_BEHAVIOUR, .step = lag_step};
