/* One message of each topic, and how often it was published. */
#pragma once
#include <string.h>
struct orb_metadata {
	void *message;
	unsigned size;
	unsigned generation;
};
#define ORB_ID(name) (&stub_orb_##name)
#define ORB_DECLARE(name) extern "C" orb_metadata stub_orb_##name
