#pragma once
#include "uORB_stub.h"
namespace uORB
{
template <typename T> class Publication
{
public:
	explicit Publication(orb_metadata *meta) : _meta(meta) {}
	bool publish(const T &message)
	{
		static_assert(__is_trivially_copyable(T), "a message");
		memcpy(_meta->message, &message, sizeof(T));
		_meta->generation++;
		return true;
	}
private:
	orb_metadata *_meta;
};
}
