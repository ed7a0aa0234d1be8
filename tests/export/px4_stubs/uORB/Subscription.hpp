#pragma once
#include "uORB_stub.h"
namespace uORB
{
class Subscription
{
public:
	explicit Subscription(orb_metadata *meta) : _meta(meta) {}
	bool update(void *to)
	{
		if (_seen == _meta->generation) {
			return false;
		}
		memcpy(to, _meta->message, _meta->size);
		_seen = _meta->generation;
		return true;
	}
private:
	orb_metadata *_meta;
	unsigned _seen{0};
};
}
